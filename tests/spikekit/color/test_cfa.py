"""The colour filter array against loops over the letters of the pattern."""

import numpy as np
import pytest
import torch
from kornia.color import CFA, rgb_to_raw

import spikekit as sk

PATTERNS = ["RGGB", "BGGR", "GRBG", "GBRG"]


def color_at(pattern, y, x):
    return "RGB".index(pattern[2 * (y % 2) + x % 2])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("scale", [1, 3, 4])
@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (4, 2)])
def test_bayer_mask_equals_a_loop(pattern, scale, height, width):
    expected = np.zeros((3, scale * height, scale * width))
    for y in range(scale * height):
        for x in range(scale * width):
            expected[color_at(pattern, y // scale, x // scale), y, x] = 1
    mask = sk.bayer_mask(height, width, pattern, scale=scale)
    assert mask.dtype == torch.get_default_dtype()
    assert np.array_equal(mask.numpy(), expected)
    assert (mask.sum(0) == 1).all()


@pytest.mark.parametrize("cfa", list(CFA))
def test_phases_are_those_of_kornia(cfa):
    rgb = torch.rand(2, 3, 4, 6)
    pattern = sk.bayer_pattern(cfa)
    assert torch.equal(sk.mosaic(rgb, cfa), rgb_to_raw(rgb, cfa)[:, 0])
    assert torch.equal(sk.mosaic(rgb, pattern), rgb_to_raw(rgb, cfa)[:, 0])
    assert torch.equal(sk.bayer_mask(4, 6, cfa), sk.bayer_mask(4, 6, pattern))


def test_pattern_may_be_in_lower_case():
    assert sk.bayer_mask(4, 4, "grbg").equal(sk.bayer_mask(4, 4, "GRBG"))
    assert sk.BinToSensor("bggr", scale=2).pattern == "BGGR"


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("scale", [1, 3, 4])
@pytest.mark.parametrize("lead", [(), (2, 3)])
def test_bin_to_sensor_equals_a_loop(pattern, scale, lead):
    rows, columns = 3, 5
    # multiples of scale^2: every mean is a whole number
    rgb = torch.randint(0, 256, (*lead, 3, scale * rows, scale * columns)).double() * scale**2
    expected = np.zeros((*lead, rows, columns))
    for y in range(rows):
        for x in range(columns):
            for a in range(scale):
                for b in range(scale):
                    site = rgb[..., color_at(pattern, y, x), scale * y + b, scale * x + a]
                    expected[..., y, x] += site.numpy() / scale**2
    for dtype in (torch.float64, torch.float32):
        raw = sk.bin_to_sensor(rgb.to(dtype), pattern, scale=scale)
        assert raw.dtype == dtype
        assert np.array_equal(raw.double().numpy(), expected)


def test_bin_to_sensor_sums_in_float32():
    rgb = torch.full((3, 4, 4), 60000.0, dtype=torch.float16)
    assert sk.bin_to_sensor(rgb, scale=4).item() == rgb[0, 0, 0].item()


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("lead", [(), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8, torch.bool])
def test_merge_undoes_split(pattern, lead, dtype):
    raw = (torch.rand(*lead, 4, 6) * 8).to(dtype)
    planes = sk.split_bayer(raw, pattern)
    assert planes.dtype == dtype
    assert planes.shape == (4, *lead, 2, 3)
    for plane, letter in zip(planes, "RGGB", strict=True):
        y, x = divmod(pattern.index(letter), 2)
        if letter != "G":
            assert torch.equal(plane, raw[..., y::2, x::2])
    g1, g2 = (i for i, letter in enumerate(pattern) if letter == "G")
    assert torch.equal(planes[1], raw[..., g1 // 2 :: 2, g1 % 2 :: 2])
    assert torch.equal(planes[2], raw[..., g2 // 2 :: 2, g2 % 2 :: 2])
    assert torch.equal(sk.merge_bayer(planes, pattern), raw)
    assert torch.equal(sk.split_bayer(sk.merge_bayer(planes, pattern), pattern), planes)


@pytest.mark.parametrize(
    ("error", "call"),
    [
        (ValueError, lambda: sk.bayer_mask(0, 2)),
        (ValueError, lambda: sk.bayer_mask(2, 2, scale=0)),
        (ValueError, lambda: sk.bayer_mask(2, 2, "RGB")),
        (ValueError, lambda: sk.bayer_mask(2, 2, None)),
        (ValueError, lambda: sk.BinToSensor("rgbg", scale=2)),
        (ValueError, lambda: sk.bin_to_sensor(torch.rand(3, 4, 5), scale=2)),
        (ValueError, lambda: sk.bin_to_sensor(torch.rand(1, 4, 4), scale=2)),
        (ValueError, lambda: sk.split_bayer(torch.ones(4, 5))),
        (ValueError, lambda: sk.merge_bayer(torch.ones(3, 2, 2))),
    ],
)
def test_invalid_arguments_are_rejected(error, call):
    with pytest.raises(error):
        call()


def test_split_colors_keeps_nan_in_its_plane():
    raw = torch.ones(2, 2)
    raw[0, 0] = float("nan")
    red, green, blue = sk.split_colors(raw)
    assert red.isnan().tolist() == [[True, False], [False, False]]
    assert green.tolist() == [[0, 1], [1, 0]]
    assert blue.tolist() == [[0, 0], [0, 1]]


def test_scale_may_be_an_integer_of_numpy():
    """A uint8 scale must not overflow sizes."""
    expected = sk.bayer_mask(100, 90, scale=3)
    assert torch.equal(sk.bayer_mask(100, np.uint8(90), scale=np.uint8(3)), expected)
    assert torch.equal(sk.BayerMask(scale=np.uint8(3))(torch.zeros(100, 90)), expected)
    rgb = torch.rand(3, 300, 270)
    assert torch.equal(sk.bin_to_sensor(rgb, scale=np.uint8(3)), sk.bin_to_sensor(rgb, scale=3))
    assert torch.equal(sk.BinToSensor(scale=np.uint8(3))(rgb), sk.bin_to_sensor(rgb, scale=3))
