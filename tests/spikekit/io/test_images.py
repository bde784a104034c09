"""Pictures to files and back, panels, flow as colour."""

import struct
import zlib

import numpy as np
import pytest
import torch
from PIL import Image
from skimage import io

from spikekit import flow_to_rgb, panel, read_picture, write_picture


def test_round_trip(tmp_path):
    rgb = torch.randint(0, 256, (3, 5, 7)) / 255
    path = tmp_path / "made" / "on the way" / "a.png"
    write_picture(path, rgb)
    assert torch.allclose(read_picture(path), rgb, atol=1e-7)
    assert np.array_equal(io.imread(path), (rgb * 255).round().byte().permute(1, 2, 0).numpy())


def test_png_is_compressed_fast(tmp_path):
    write_picture(tmp_path / "a.png", torch.rand(3, 40, 50))
    data = (tmp_path / "a.png").read_bytes()
    stream = data[data.index(b"IDAT") + 4 :]
    assert stream[1] >> 6 == 1  # what zlib says of its levels 2 to 5; the usual 6 is 2


def test_written_values(tmp_path):
    values = torch.tensor([[-1.0, 0.0, 0.4 / 255, 0.6 / 255, 1.0, 2.0, float("nan")]])
    for dtype in (torch.float64, torch.float32, torch.bfloat16):
        write_picture(tmp_path / "grey.png", values.to(dtype).requires_grad_())
        assert io.imread(tmp_path / "grey.png").tolist() == [[0, 0, 0, 1, 255, 255, 0]]


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (np.full((4, 5), 51, np.uint8), [0.2, 0.2, 0.2]),
        (np.full((4, 5), 13107, np.uint16), [0.2, 0.2, 0.2]),
        (np.full((4, 5), 1, np.uint16), [1 / 65535] * 3),
        (np.full((4, 5, 3), [0, 51, 255], np.uint8), [0, 0.2, 1]),
        (np.full((4, 5, 4), [0, 51, 255, 255], np.uint8), [0, 0.2, 1]),
        (np.full((4, 5, 4), [0, 51, 255, 0], np.uint8), [1, 1, 1]),
    ],
)
def test_read(tmp_path, pixels, expected):
    io.imsave(tmp_path / "a.png", pixels, check_contrast=False)
    rgb = read_picture(tmp_path / "a.png")
    assert rgb.shape == (3, 4, 5)
    assert rgb.dtype == torch.float32
    assert rgb.is_contiguous()
    assert torch.allclose(rgb, torch.tensor(expected, dtype=torch.float32).reshape(3, 1, 1).expand(3, 4, 5), atol=1e-7)


def write_png16(path, pixels):
    """A PNG of 16 bits a channel, (H, W, C), which neither Pillow nor scikit-image writes in colour."""
    height, width, channels = pixels.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, {3: 2, 4: 6}[channels], 0, 0, 0)
    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")):
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))


@pytest.mark.parametrize("channels", [3, 4])
def test_16_bits_in_colour(tmp_path, channels):
    pixels = np.random.default_rng(0).integers(0, 65536, (4, 5, channels)).astype(np.uint16)
    write_png16(tmp_path / "a.png", pixels)
    expected = pixels[..., :3] / 65535
    if channels == 4:
        alpha = pixels[..., 3:] / 65535
        expected = alpha * expected + (1 - alpha)
    rgb = read_picture(tmp_path / "a.png").permute(1, 2, 0).numpy()
    assert np.abs(rgb - expected).max() < 1e-6  # one part in 65535 is 1.5e-5


@pytest.mark.parametrize(
    ("mode", "color", "expected"),
    [
        ("1", 1, [1, 1, 1]),
        ("LA", (51, 255), [0.2, 0.2, 0.2]),
        ("LA", (51, 0), [1, 1, 1]),
        ("P", (255, 0, 51), [1, 0, 0.2]),
        ("CMYK", (0, 255, 255, 0), [1, 0, 0]),  # of four channels, none of which is alpha
    ],
)
def test_read_modes(tmp_path, mode, color, expected):
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    Image.new("RGB" if mode == "P" else mode, (5, 4), color).convert(mode).save(path)
    rgb = read_picture(path)
    assert torch.allclose(rgb, torch.tensor(expected, dtype=torch.float32).reshape(3, 1, 1).expand(3, 4, 5), atol=1e-6)


def test_palette_with_a_transparent_colour(tmp_path):
    picture = Image.new("P", (5, 4), 1)
    picture.putpalette([0, 0, 0, 255, 0, 0])
    picture.save(tmp_path / "red.png")
    picture.save(tmp_path / "clear.png", transparency=1)
    assert read_picture(tmp_path / "red.png")[:, 0, 0].tolist() == [1, 0, 0]
    assert read_picture(tmp_path / "clear.png")[:, 0, 0].tolist() == [1, 1, 1]


def test_files_that_are_no_pictures(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"a\.png"):
        read_picture(tmp_path / "a.png")
    (tmp_path / "a.png").write_text("no picture")
    with pytest.raises(ValueError, match=r"a\.png"):
        read_picture(tmp_path / "a.png")


@pytest.mark.parametrize("shape", [(4,), (1, 4, 4), (2, 3, 4, 4)])
def test_write_errors(tmp_path, shape):
    with pytest.raises(ValueError, match="image"):
        write_picture(tmp_path / "a.png", torch.zeros(shape))


def test_panel():
    a, b, c = torch.full((3, 2, 3), 0.25), torch.full((4, 2), 0.5), torch.full((3, 1, 5), 0.75)
    sheet = panel([[a, b], [c]], gap=1)
    expected = torch.ones(3, 6, 8)
    expected[:, :2, :3] = 0.25
    expected[:, :4, 6:8] = 0.5
    expected[:, 5:, :5] = 0.75
    assert torch.equal(sheet, expected)


@pytest.mark.parametrize(
    ("x", "y", "rgb"),
    [
        (0, 0, [1, 1, 1]),
        (2, 0, [1, 0, 0]),
        (1, 0, [1, 0.5, 0.5]),
        (-2, 0, [0, 1, 1]),
        (0, 2, [0.5, 1, 0]),  # down
        (0, -2, [0.5, 0, 1]),  # up
        (8, 0, [1, 0, 0]),  # longer than max_flow
    ],
)
def test_flow_to_rgb(x, y, rgb):
    flow = torch.tensor([x, y], dtype=torch.float32).reshape(1, 2, 1, 1)
    assert torch.allclose(flow_to_rgb(flow, 2.0).flatten(), torch.tensor(rgb, dtype=torch.float32), atol=1e-5)


def test_flow_to_rgb_scales_to_the_longest():
    flow = torch.randn(2, 5, 2, 4, 6)
    colors = flow_to_rgb(flow)
    assert colors.shape == (2, 5, 3, 4, 6)
    assert ((colors >= 0) & (colors <= 1)).all()
    assert torch.allclose(colors, flow_to_rgb(3 * flow), atol=1e-5)
    assert torch.allclose(colors, flow_to_rgb(flow, flow.norm(dim=2).max().item()), atol=1e-5)
    with pytest.raises(ValueError, match="flow"):
        flow_to_rgb(flow[:, :, 0])


@pytest.mark.parametrize("rows", [[], [[]], [[torch.zeros(2, 2)], []]])
def test_panel_of_nothing(rows):
    with pytest.raises(ValueError, match="rows"):
        panel(rows)


@pytest.mark.parametrize("longest", [0, -1.0, float("nan")])
def test_wrong_max_flow(longest):
    with pytest.raises(ValueError, match=f"max_flow: expected a finite number above 0, got {longest}"):
        flow_to_rgb(torch.ones(2, 1, 1), longest)


@pytest.mark.parametrize("longest", ["1", [1.0], 1j, torch.ones(2), np.ones(2)])
def test_max_flow_that_is_no_number(longest):
    with pytest.raises(TypeError, match="max_flow: expected a finite number above 0, got "):
        flow_to_rgb(torch.ones(2, 1, 1), longest)


def test_flow_to_rgb_of_flow_that_is_not_finite():
    """NaN is no motion; infinite flow points where it points, in full colour, and leaves others their colours."""
    nan, inf = float("nan"), float("inf")
    flow = torch.tensor([[[nan, inf, -inf, 1.0]], [[nan, 0.0, 0.0, 0.0]]])
    white, right, left = torch.ones(3), torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 1])
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        colors = flow_to_rgb(flow.to(dtype), 1.0)
        assert colors.dtype is dtype
        expected = torch.stack([white, right, left, right], dim=-1)[:, None]
        torch.testing.assert_close(colors.float(), expected, rtol=0, atol=1e-2)
        assert flow_to_rgb(flow.to(dtype)).isfinite().all()


def test_flow_to_rgb_of_nothing():
    assert flow_to_rgb(torch.zeros(0, 2, 3, 4)).shape == (0, 3, 3, 4)


def test_flow_to_rgb_in_half_precision():
    """Lengths beyond what the type holds have colours as well."""
    flow = torch.tensor([60000.0, 60000.0]).reshape(2, 1, 1)
    torch.testing.assert_close(flow_to_rgb(flow.half()).float(), flow_to_rgb(flow), rtol=0, atol=1e-3)


@pytest.mark.parametrize("shape", [(2, 4, 5), (4, 4, 5), (1, 3, 4, 5)])
def test_panel_of_other_pictures(shape):
    with pytest.raises(ValueError, match=r"rows: expected pictures \(3, H, W\) or \(H, W\), got one of"):
        panel([[torch.zeros(3, 4, 5), torch.zeros(shape)]])
    with pytest.raises(TypeError, match="rows: expected a tensor"):
        panel([[np.zeros((4, 5))]])
    assert torch.equal(panel([[torch.zeros(1, 4, 5)]]), torch.zeros(3, 4, 5))
