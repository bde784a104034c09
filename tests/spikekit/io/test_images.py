"""Picture files, panels, and flow as colour."""

import numpy as np
import pytest
import tifffile
import torch
from deep_pictures import write_lzw_tiff
from PIL import Image

from spikekit import flow_to_rgb, panel, read_picture, write_picture
from spikekit.io.images import picture_size, png_bytes


def over_white(pixels):
    """Return pixels (H, W, C), 0 to 1, as a picture (3, H, W) over white."""
    colors = pixels.shape[-1] - 1 + pixels.shape[-1] % 2
    alpha = pixels[..., colors:] if colors < pixels.shape[-1] else 1
    return np.broadcast_to(alpha * pixels[..., :colors] + 1 - alpha, (*pixels.shape[:2], 3)).transpose(2, 0, 1)


def numbers(bits, channels, size=(6, 9)):
    drawn = np.random.default_rng(bits).integers(0, 1 << bits, (*size, channels))
    return drawn.astype(f"uint{max(bits, 8)}")


TURNED = {  # what orientation of EXIF stores a picture in which way, and what it looks like
    1: lambda seen: seen,
    2: lambda seen: seen[:, ::-1],
    3: lambda seen: seen[::-1, ::-1],
    4: lambda seen: seen[::-1],
    5: lambda seen: seen.swapaxes(0, 1),
    6: lambda seen: np.rot90(seen, -1),
    7: lambda seen: np.rot90(seen, -1)[::-1],
    8: lambda seen: np.rot90(seen),
}


def reads(path, expected, atol):
    rgb = read_picture(path)
    assert rgb.dtype == torch.float32
    assert rgb.is_contiguous()
    np.testing.assert_allclose(rgb.numpy(), expected, rtol=0, atol=atol)
    assert picture_size(path) in (tuple(expected.shape[1:]), None)  # without reading it; Pillow does not know some


@pytest.mark.parametrize("bits", [8, 16, 32])
@pytest.mark.parametrize("pack", [{}, {"compression": "zlib", "predictor": True}, {"tile": (16, 16)}])
def test_tiffs_of_every_depth_and_photometric_kind(tmp_path, bits, pack):
    path, grey, rgb, rgba = tmp_path / "a.tif", *(numbers(bits, channels) for channels in (1, 3, 4))
    most, close = 2**bits - 1, {8: 1e-7, 16: 1e-7, 32: 1e-6}[bits]
    tifffile.imwrite(path, grey[..., 0], photometric="minisblack", **pack)
    reads(path, over_white(grey / most), close)
    tifffile.imwrite(path, grey[..., 0], photometric="miniswhite", **pack)
    reads(path, over_white(1 - grey / most), close)
    for turned, look in TURNED.items():
        tags = [(274, "H", 1, turned, True)]
        tifffile.imwrite(path, rgb, photometric="rgb", extratags=tags, **pack)
        reads(path, over_white(look(rgb / most)), close)
    tifffile.imwrite(path, np.moveaxis(rgb, -1, 0), photometric="rgb", planarconfig="separate", **pack)
    reads(path, over_white(rgb / most), close)
    tifffile.imwrite(path, rgba, photometric="rgb", extrasamples=["unassalpha"], **pack)
    reads(path, over_white(rgba / most), close)
    tifffile.imwrite(path, rgba, photometric="rgb", extrasamples=["unspecified"], **pack)
    reads(path, over_white(rgba[..., :3] / most), close)
    rgba[..., :3] = rgba[..., :3] / most * rgba[..., 3:]
    tifffile.imwrite(path, rgba, photometric="rgb", extrasamples=["assocalpha"], **pack)
    reads(path, (rgba[..., :3] / most + 1 - rgba[..., 3:] / most).transpose(2, 0, 1), max(close, 2 / most))


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw", "tiff_deflate", "packbits", "jpeg"])
def test_tiffs_as_pillow_packs_them(tmp_path, compression):
    rgb = Image.fromarray(numbers(8, 3))
    kinds = [rgb, rgb.convert("L"), rgb.convert("CMYK"), Image.fromarray(numbers(8, 4))]
    if compression != "jpeg":
        kinds += [rgb.quantize(16), rgb.convert("1"), Image.fromarray(numbers(16, 1)[..., 0])]
    for picture in kinds:
        picture.save(tmp_path / "a.tif", compression=compression)
        with Image.open(tmp_path / "a.tif") as seen:
            deep = seen.mode == "I;16"
            pixels = np.asarray(seen if deep or seen.mode == "RGBA" else seen.convert("RGB")) / (65535 if deep else 255)
        reads(tmp_path / "a.tif", over_white(pixels.reshape(*pixels.shape[:2], -1)), 1e-6)


@pytest.mark.parametrize(
    ("kind", "most"),
    [
        *((kind, most) for kind in ("P2", "P3", "P5", "P6") for most in (1, 15, 255)),
        *((kind, most) for kind in ("P2", "P5") for most in (256, 1023, 65535)),
    ],
)
def test_portable_maps_of_any_depth(tmp_path, kind, most):
    pixels = np.random.default_rng(most).integers(0, most + 1, (6, 9, 3 if kind in ("P3", "P6") else 1))
    head = f"{kind}\n# a comment\n9 6\n{most}\n".encode()
    plain = " ".join(map(str, pixels.ravel())).encode() + b"\n"
    packed = pixels.astype(">u2" if most > 255 else "u1").tobytes()
    (tmp_path / "a.ppm").write_bytes(head + (plain if kind in ("P2", "P3") else packed))
    reads(tmp_path / "a.ppm", over_white(pixels / most), 1e-5 if most >= 255 else 1 / 255)


@pytest.mark.parametrize("ending", ["png", "jpg", "webp"])
@pytest.mark.parametrize("turned", TURNED)
def test_exif_orientation_is_applied(tmp_path, ending, turned):
    exif = Image.Exif()
    exif[274] = turned
    Image.fromarray(np.kron(numbers(8, 3), np.ones((16, 16, 1), np.uint8))).save(tmp_path / f"a.{ending}", exif=exif)
    with Image.open(tmp_path / f"a.{ending}") as picture:
        seen = TURNED[turned](np.asarray(picture.convert("RGB")) / 255)
    reads(tmp_path / f"a.{ending}", over_white(seen), 1e-6)


def test_16_bits_of_packed_colours_are_kept(tmp_path):
    """Pillow would keep 8 bits; if the depth cannot be read, there is a one-line error."""
    rgb, rgba = (numbers(16, channels) for channels in (3, 4))
    write_lzw_tiff(tmp_path / "a.tif", rgb)
    reads(tmp_path / "a.tif", over_white(rgb / 65535), 1e-7)
    write_lzw_tiff(tmp_path / "b.tif", rgba, extrasamples=["unassalpha"])
    with pytest.raises(ValueError, match=r"b\.tif: .*expected the package imagecodecs for 16 bits"):
        read_picture(tmp_path / "b.tif")


@pytest.mark.parametrize(
    ("mode", "color", "expected"),
    [
        ("1", 1, [1, 1, 1]),
        ("L", 51, [0.2, 0.2, 0.2]),
        ("I;16", 13107, [0.2, 0.2, 0.2]),
        ("RGB", (0, 51, 255), [0, 0.2, 1]),
        ("RGBA", (0, 51, 255, 255), [0, 0.2, 1]),
        ("RGBA", (0, 51, 255, 0), [1, 1, 1]),
        ("LA", (51, 255), [0.2, 0.2, 0.2]),
        ("LA", (51, 0), [1, 1, 1]),
        ("P", (255, 0, 51), [1, 0, 0.2]),
    ],
)
def test_pngs_of_every_mode(tmp_path, mode, color, expected):
    picture = Image.new("RGB" if mode == "P" else mode, (5, 4), color).convert(mode)
    picture.save(tmp_path / "a.png")
    reads(tmp_path / "a.png", np.broadcast_to(np.reshape(expected, (3, 1, 1)), (3, 4, 5)), 1e-7)
    if mode == "P":
        picture.save(tmp_path / "a.png", transparency=picture.getpixel((0, 0)))
        assert (read_picture(tmp_path / "a.png") == 1).all()


# --- written ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("ending", "bits"), [("png", 8), ("bmp", 8), ("ppm", 8), ("png", 16), ("TIFF", 16)])
@pytest.mark.parametrize("shape", [(3, 6, 9), (6, 9)])
def test_written_pictures_are_read_back(tmp_path, ending, bits, shape):
    image = torch.randint(0, 1 << bits, shape) / (2**bits - 1)
    write_picture(tmp_path / "made" / "on the way" / f"a.{ending}", image, bits=bits)
    reads(tmp_path / "made" / "on the way" / f"a.{ending}", image.expand(3, 6, 9).numpy(), 1e-6)


def test_values_are_clamped_and_rounded(tmp_path):
    values = torch.tensor([[-1.0, 0.0, 0.4 / 255, 0.6 / 255, 1.0, 2.0, float("nan")]])
    for dtype in (torch.float64, torch.float32, torch.bfloat16):
        write_picture(tmp_path / "grey.png", values.to(dtype).requires_grad_())
        with Image.open(tmp_path / "grey.png") as picture:
            assert np.asarray(picture).tolist() == [[0, 0, 0, 1, 255, 255, 0]]


def test_pngs_carry_notes_and_quality_makes_jpegs_larger(tmp_path):
    (tmp_path / "a.png").write_bytes(png_bytes(torch.rand(3, 4, 6), {"frame": "7"}))
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.info == {"frame": "7"}
    for quality in (20, 95):
        write_picture(tmp_path / f"{quality}.jpg", torch.rand(3, 40, 60), quality=quality)
    assert (tmp_path / "95.jpg").stat().st_size > 2 * (tmp_path / "20.jpg").stat().st_size


@pytest.mark.parametrize(
    ("name", "shape", "how", "said"),
    [
        ("a.jpg", (3, 4, 6), {"bits": 16}, "bits: expected"),
        ("a.png", (3, 4, 6), {"bits": 12}, "bits: expected"),
        ("a.png", (3, 4, 6), {"quality": 90}, "quality: expected"),
        ("a.jpg", (3, 4, 6), {"quality": 101}, "quality: expected"),
        ("a.jpg", (1, 70_000), {}, "expected a size that JPEG can store"),
        ("a.xyz", (3, 4, 6), {}, "expected the ending of a picture"),
        *(("a.png", shape, {}, "image") for shape in ((4,), (1, 4, 4), (2, 3, 4, 4))),
    ],
)
def test_invalid_pictures_are_not_written(tmp_path, name, shape, how, said):
    with pytest.raises(ValueError, match=said):
        write_picture(tmp_path / name, torch.zeros(shape), **how)
    with pytest.raises(FileNotFoundError, match=name):
        read_picture(tmp_path / name)


# --- panels and flow --------------------------------------------------------------------------------------------------


def test_panel():
    a, b, c, d = torch.full((3, 2, 3), 0.25), torch.full((4, 2), 0.5), torch.full((3, 1, 5), 0.75), torch.zeros(1, 1, 1)
    expected = torch.ones(3, 6, 8)
    expected[:, :2, :3], expected[:, :4, 6:8], expected[:, 5:, :5], expected[:, 5, 6] = 0.25, 0.5, 0.75, 0
    assert torch.equal(panel([[a, b], [c, d]], gap=1), expected)
    for rows in ([], [[]], [[a], []], *([[a, torch.zeros(shape)]] for shape in ((2, 4, 5), (4, 4, 5), (1, 3, 4, 5)))):
        with pytest.raises(ValueError, match="rows: expected"):
            panel(rows)
    with pytest.raises(TypeError, match="rows: expected a tensor"):
        panel([[np.zeros((4, 5))]])


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
        (float("nan"), float("nan"), [1, 1, 1]),
        (float("inf"), 0, [1, 0, 0]),
        (float("-inf"), 0, [0, 1, 1]),
    ],
)
def test_flow_to_rgb(x, y, rgb):
    for dtype in (torch.float64, torch.float32, torch.float16, torch.bfloat16):
        flow = torch.tensor([x, y], dtype=dtype).reshape(1, 2, 1, 1)
        colors = flow_to_rgb(flow, 2.0)
        assert colors.dtype is dtype
        close = 1e-5 if dtype.itemsize > 2 else 1e-2
        torch.testing.assert_close(colors.flatten().float(), torch.tensor(rgb, dtype=torch.float32), rtol=0, atol=close)
        assert flow_to_rgb(flow).isfinite().all()


def test_flow_to_rgb_scales_to_the_longest():
    flow = torch.randn(2, 5, 2, 4, 6)
    colors = flow_to_rgb(flow)
    assert colors.shape == (2, 5, 3, 4, 6)
    assert ((colors >= 0) & (colors <= 1)).all()
    assert torch.allclose(colors, flow_to_rgb(3 * flow), atol=1e-5)
    assert torch.allclose(colors, flow_to_rgb(flow, flow.norm(dim=2).max().item()), atol=1e-5)
    assert flow_to_rgb(torch.zeros(0, 2, 3, 4)).shape == (0, 3, 3, 4)
    far = torch.full((2, 1, 1), 60000.0)  # beyond what half precision holds
    torch.testing.assert_close(flow_to_rgb(far.half()).float(), flow_to_rgb(far), rtol=0, atol=1e-3)
