"""Images: read and write their files, encode them, lay out panels, colour-code flow."""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any
from zlib import Z_HUFFMAN_ONLY

import numpy as np
import torch
from torch import Tensor

from spikekit.arguments import home_path, one_line
from spikekit.check import check_picture, check_planes, check_positive
from spikekit.io.quiet import quiet
from spikekit.io.whole_file import write_whole

#: Largest number of pixels that is read; a small file could claim more than fits into memory.
MOST_PIXELS = 1 << 27

_ORIENTATION = 0x0112  # tag of EXIF and TIFF
_PNG = b"\x89PNG"
_FARTHEST = 1e9  # stands for infinite flow, in pixels


class PictureError(ValueError):
    """An unreadable picture; the message is one line and names the file."""


def read_picture(path: str | Path) -> Tensor:
    """Read a picture file as a colour image, upright according to its EXIF orientation.

    Grey pictures get three equal channels. 16-bit files keep their depth, except CMYK, colour PNM, and PNG of grey with
    alpha, which are read with 8 bits. Transparent pixels are blended with white. Values stay gamma-encoded as in the
    file.

    Args:
        path: a PNG, JPEG, TIFF (its first page), PNM or any other file that Pillow reads.

    Returns:
        ``rgb`` of shape (3, H, W), float32, in [0, 1].

    Raises:
        FileNotFoundError: the file does not exist.
        PictureError: the file is not a readable picture, or has more than 2^27 pixels.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_picture(f"{folder}/grey.png", torch.full((4, 6), 0.2))
        ...     read_picture(f"{folder}/grey.png").shape
        torch.Size([3, 4, 6])
    """
    path = home_path(path)
    if not path.is_file():  # a pipe could block
        raise FileNotFoundError(f"{path}: no such picture")
    try:
        with quiet():
            pixels, turned = _pixels(path)
        pixels = _UPRIGHT.get(turned, np.asarray)(pixels)
        if pixels.ndim != 3 or 0 in pixels.shape or pixels.shape[-1] > 4:
            raise ValueError(f"expected a grey or colour picture, got an array of shape {pixels.shape}")
    except Exception as error:
        said = one_line(error).removeprefix(f"{path}: ")[:300]
        raise PictureError(f"{path}: not a readable picture ({said})") from error
    colors = pixels.shape[-1] - 1 + pixels.shape[-1] % 2
    if colors < pixels.shape[-1]:
        alpha = pixels[..., colors:]
        pixels = np.clip((1 - alpha) + alpha * pixels[..., :colors], 0, 1)
    return torch.from_numpy(pixels.astype("float32")).permute(2, 0, 1).expand(3, -1, -1).contiguous()


#: Functions that turn pixels (H, W, C) upright, by EXIF orientation.
_UPRIGHT = {
    2: np.fliplr,
    3: lambda pixels: pixels[::-1, ::-1],
    4: np.flipud,
    5: lambda pixels: pixels.swapaxes(0, 1),
    6: lambda pixels: np.rot90(pixels, -1),
    7: lambda pixels: pixels[::-1, ::-1].swapaxes(0, 1),
    8: np.rot90,
}


def picture_size(path: str | Path) -> tuple[int, int] | None:
    """Return (H, W) of an upright picture from its header alone; ``None`` if that cannot be read."""
    from PIL import Image

    if not Path(path).is_file():  # a pipe could block
        return None
    try:
        with quiet(), Image.open(path) as picture:
            tiff = picture.tag_v2 if picture.format == "TIFF" else {}  # some versions of Pillow have swapped its size
            width, height = tiff.get(256, picture.width), tiff.get(257, picture.height)
            return (width, height) if _orientation(picture) >= 5 else (height, width)
    except Exception:
        return None


def _orientation(picture: Any) -> int:
    with suppress(Exception):  # damaged EXIF is ignored
        return picture.getexif().get(_ORIENTATION, 1)
    return 1


def _pixels(path: Path) -> tuple[np.ndarray, int]:
    """Return the pixels of a file, (H, W, C), 0 to 1, with straight alpha, and its orientation.

    The header selects a single library. A reader with fallbacks could pass a hostile file to FFmpeg, which follows
    playlists to other files.
    """
    from kornia_rs.io import read_image_png_u16, read_image_tiff_u16
    from PIL import Image

    with path.open("rb") as opened:
        head = opened.read(26)
    tiff = head[:2] in (b"II", b"MM")
    if tiff and (plain := _plain_tiff(path)) is not None:
        return plain
    kind = (head[:4], *head[24:])  # for PNG: signature, bit depth, colour type
    with Image.open(path) as picture:
        _check_pixels(picture.height * picture.width)
        tags = getattr(picture, "tag_v2", {})
        bits = tags.get(258, (16,))
        if kind[:2] == (_PNG, 16) and kind[2] in (2, 6):  # 16-bit colour, which Pillow reduces to 8 bits
            pixels = _unit(read_image_png_u16(str(path), "rgb" if kind[2] == 2 else "rgba"), 16)
        elif tiff and max(bits) > 8 and tags.get(262) == 2:  # 16-bit RGB
            if len(bits) != 3 or tags.get(284, 1) != 1:
                raise ValueError("expected the package imagecodecs for 16 bits in this packing and layout, got none")
            pixels = _unit(read_image_tiff_u16(str(path), "rgb"), 16)
        elif picture.mode.startswith("I;16") or (picture.mode == "I" and picture.format in ("PNG", "PPM")):
            pixels = _unit(np.asarray(picture), bits[0])
            pixels = 1 - pixels if tags.get(262) == 0 else pixels  # white is 0
        elif picture.mode == "F":
            pixels = np.asarray(picture)
        elif picture.mode == "I":
            raise ValueError(f"expected 8 or 16 bits, or floating point, got {picture.format} of integers")
        else:
            pixels = _unit(np.asarray(picture.convert("RGBA" if picture.has_transparency_data else "RGB")), 8)
        turned = _orientation(picture)  # after loading: Pillow turns a TIFF upright
    return pixels.reshape(*pixels.shape[:2], -1), turned


def _plain_tiff(path: Path) -> tuple[np.ndarray, int] | None:
    """Read the first page of a TIFF at full depth, which Pillow would reduce; ``None`` if only Pillow can read it."""
    from tifffile import TiffFile

    with TiffFile(path) as file:
        page = file.pages.first
        bits, photometric = int(np.max(page.bitspersample)), int(page.photometric)
        if (bits in (1, 2, 4) and photometric < 2) or photometric not in (0, 1, 2):  # white is 0, black is 0, RGB
            return None
        _check_pixels(max(math.prod(page.shape), math.prod(page.chunks)) / 4)  # of up to four channels
        try:
            pixels = page.asarray()
        except ValueError as error:
            if "imagecodecs" in str(error):  # LZW, JPEG and others need that package
                return None
            raise
        if pixels.ndim == 3 and page.planarconfig == 2:
            pixels = np.moveaxis(pixels, 0, -1)
        pixels = pixels.reshape(*pixels.shape[:2], -1) if pixels.ndim < 4 else pixels
        pixels = pixels if pixels.dtype.kind == "f" else _unit(pixels, bits)
        extra = tuple(map(int, page.extrasamples))
        turned = page.tags.valueof(_ORIENTATION, 1)
    colors = pixels.shape[-1] - len(extra)
    if photometric == 0:
        pixels[..., :colors] = 1 - pixels[..., :colors]
    if extra[:1] == (1,):  # premultiplied alpha
        alpha = pixels[..., colors : colors + 1]
        pixels[..., :colors] /= np.where(alpha > 0, alpha, 1)
    return pixels[..., : colors + (extra[:1] in ((1,), (2,)))], turned


def _unit(pixels: np.ndarray, bits: int) -> np.ndarray:
    """Scale whole numbers of ``bits`` bits to 0 .. 1, float32."""
    if pixels.dtype.kind not in "ui" or bits > 32:
        raise ValueError(f"expected whole numbers of at most 32 bits or floating point, got {pixels.dtype}")
    if pixels.dtype.kind == "i" and pixels.min() < 0:
        raise ValueError(f"expected values >= 0, got {pixels.min()}")
    kind = np.float32 if bits <= 16 else np.float64
    return np.multiply(pixels, 1 / (2**bits - 1), dtype=kind).astype(np.float32, copy=False)


def _check_pixels(count: float) -> None:
    """Raise if a picture has more than ``MOST_PIXELS`` pixels."""
    if count > MOST_PIXELS:
        raise ValueError(f"expected at most {MOST_PIXELS} pixels, got {count:.0f}")


def write_picture(path: str | Path, image: Tensor, *, bits: int = 8, quality: int | None = None) -> None:
    """Write an image to a file, and create its folder if needed.

    Args:
        path: the file to write; the ending selects the format.
        image: (3, H, W) or (H, W), floating, [0, 1]; clamped and rounded to ``bits``; NaN is black.
        bits: bits per channel: 8, or 16 for PNG and TIFF.
        quality: quality of JPEG and WebP, 1 to 100; default: Pillow's.

    Raises:
        TypeError: ``image`` is not a floating-point tensor.
        ValueError: ``image`` has another shape, or the format is unknown or does not support ``bits`` or ``quality``.
        OSError: the file cannot be written; an existing file is kept.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_picture(f"{folder}/new/red.png", torch.tensor([1.2, 0.0, -0.1]).reshape(3, 1, 1))
        ...     read_picture(f"{folder}/new/red.png").flatten().tolist()
        [1.0, 0.0, 0.0]
    """
    check_picture("image", image, "(3, H, W) or (H, W)", grey=True)
    path = home_path(path)
    write_whole(path, picture_bytes(image, path.suffix, bits=bits, quality=quality))


def to_bytes(image: Tensor, bits: int = 8) -> Tensor:
    """Round an image (*, 3, H, W) or (H, W) in [0, 1] to 8 or 16 bits: (*, H, W, 3) or (H, W).

    Values are clamped, NaN is black. A uint8 image is not scaled.
    """
    pixels = image.detach().cpu()
    if pixels.dtype != torch.uint8:
        kind = torch.uint8 if bits == 8 else torch.uint16
        pixels = pixels.float().nan_to_num(0).clamp_(0, 1).mul_((1 << bits) - 1).round_().to(kind)
    return pixels if pixels.ndim == 2 else pixels.movedim(-3, -1).contiguous()


def png_bytes(image: Tensor, notes: Mapping[str, str] | None = None) -> bytes:
    """Return an image (3, H, W) or (H, W) as an 8-bit PNG file, with ASCII notes before the pixels."""
    from PIL.PngImagePlugin import PngInfo

    said = PngInfo()
    for name, text in (notes or {}).items():
        said.add_text(name, text)
    return _pillow_bytes(to_bytes(image), "PNG", pnginfo=said)


def png_pixels(path: str | Path) -> Tensor:
    """Return the pixels of an 8-bit PNG file, (3, H, W), uint8."""
    from PIL import Image

    try:
        with quiet(), Image.open(path, formats=["PNG"]) as picture:
            return torch.from_numpy(np.array(picture.convert("RGB"))).movedim(-1, 0)
    except Exception as error:
        raise PictureError(f"{path}: not a readable picture ({one_line(error)})") from error


def picture_bytes(image: Tensor, ending: str, *, bits: int = 8, quality: int | None = None) -> bytes:
    """Return the bytes of an image file in the format of ``ending``; see :func:`spikekit.write_picture`."""
    from PIL import Image

    formats = {name: kind for name, kind in Image.registered_extensions().items() if kind in Image.SAVE}
    kind = formats.get(ending.lower())
    if kind is None:
        raise ValueError(f"expected the ending of a picture, such as .png, got {ending or 'none'}")
    if bits not in (8, 16) or (bits == 16 and kind not in ("PNG", "TIFF")):
        raise ValueError(f"bits: expected 8, or 16 for .png and .tif, got {bits} for {ending}")
    if quality is not None and (kind not in ("JPEG", "WEBP") or not 1 <= quality <= 100):
        raise ValueError(f"quality: expected 1 to 100 for .jpg and .webp, got {quality} for {ending}")
    pixels = to_bytes(image, bits)
    if bits == 16 and kind == "PNG" and pixels.ndim == 3:  # Pillow cannot write it
        from kornia_rs.io import write_image_png_u16

        with tempfile.TemporaryDirectory() as folder:
            write_image_png_u16(f"{folder}/rgb.png", pixels.numpy(), "rgb")
            return Path(folder, "rgb.png").read_bytes()
    if bits == 16 and kind == "TIFF":
        from tifffile import imwrite

        file = io.BytesIO()
        imwrite(file, pixels.numpy(), photometric="rgb" if pixels.ndim == 3 else "minisblack")
        return file.getvalue()
    return _pillow_bytes(pixels, kind, **({} if quality is None else {"quality": int(quality)}))


def _pillow_bytes(pixels: Tensor, kind: str, **how: Any) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    # PNG: no search for repetitions, which are rare in photographs: faster than any level of compression
    try:
        Image.fromarray(pixels.numpy()).save(file, kind, compress_level=1, compress_type=Z_HUFFMAN_ONLY, **how)
    except OSError as error:
        raise ValueError(f"expected a size that {kind} can store, got {tuple(pixels.shape[:2])}") from error
    return file.getvalue()


def panel(rows: Sequence[Sequence[Tensor]], gap: int = 4) -> Tensor:
    """Arrange pictures in rows and columns on white.

    Args:
        rows: pictures (3, H, W), (1, H, W) or (H, W); rows may differ in length, pictures in size.
        gap: white pixels between two pictures.

    Returns:
        One picture (3, H, W), float32, on the CPU; every input is aligned to the top left of its cell.

    Raises:
        TypeError: a picture is not a tensor of real numbers.
        ValueError: there are no rows, a row is empty, or a picture has another shape.

    Example:
        >>> panel([[torch.zeros(3, 4, 4), torch.zeros(4, 4)], [torch.zeros(3, 2, 4)]], gap=1).shape
        torch.Size([3, 7, 9])
    """
    if not rows or not all(rows):
        raise ValueError("rows: expected at least one row, and a picture in each, got none")
    for picture in chain.from_iterable(rows):
        check_planes("rows", picture, 2, "(3, H, W) or (H, W)")
        if picture.shape[:-2] not in ((), (1,), (3,)):
            raise ValueError(f"rows: expected pictures (3, H, W) or (H, W), got one of {tuple(picture.shape)}")
    heights = [max(picture.shape[-2] for picture in row) for row in rows]
    columns = range(max(len(row) for row in rows))
    widths = [max(row[i].shape[-1] for row in rows if i < len(row)) for i in columns]
    size = sum(heights) + gap * (len(heights) - 1), sum(widths) + gap * (len(widths) - 1)
    sheet = torch.ones(3, *size, device="cpu")
    top = 0
    for row, height in zip(rows, heights, strict=True):
        left = 0
        for picture, width in zip(row, widths, strict=False):
            h, w = picture.shape[-2:]
            sheet[:, top : top + h, left : left + w] = picture.detach().float().cpu()
            left += width + gap
        top += height + gap
    return sheet


def flow_to_rgb(flow: Tensor, max_flow: float | None = None) -> Tensor:
    r"""Colour-code flow: direction is hue, length is saturation, zero is white.

    .. math:: \text{hue} = \operatorname{atan2}(v, u), \quad \text{saturation} = \min(1, \sqrt{u^2 + v^2} / l)

    Convention:
        Flow in pixels, order (x, y), x right, y down. Red points right, and the hue turns clockwise on the screen.
        NaN counts as 0, infinite flow as very long. For display only: the gradient at zero flow is NaN.

    Args:
        flow: :math:`(*, 2, H, W)`, floating.
        max_flow: l, the length of full saturation, above 0; default: the largest length of the tensor.

    Returns:
        ``rgb`` of shape :math:`(*, 3, H, W)`, [0, 1].

    Raises:
        TypeError: ``flow`` is not a floating-point tensor.
        ValueError: ``flow`` has no two channels, or ``max_flow`` is not above 0.

    Example:
        >>> flow_to_rgb(torch.zeros(2, 1, 1)).flatten().tolist()
        [1.0, 1.0, 1.0]
    """
    check_planes("flow", flow, 3, "(*, 2, H, W)", floating=True)
    if flow.shape[-3] != 2:
        raise ValueError(f"flow: expected (*, 2, H, W), got {tuple(flow.shape)}")
    if max_flow is not None:
        check_positive("max_flow", max_flow)
    wide = flow.to(torch.promote_types(flow.dtype, torch.float32))
    x, y = wide.nan_to_num(0.0).clamp(-_FARTHEST, _FARTHEST).unbind(-3)
    length = torch.hypot(x, y)
    if max_flow is None:
        max_flow = length.amax().clamp(min=1e-6) if length.numel() else 1.0
    from kornia.color import hsv_to_rgb

    hue = torch.atan2(y, x).remainder(2 * math.pi)
    hsv = torch.stack([hue, (length / max_flow).clamp(max=1), torch.ones_like(length)], dim=-3)
    return hsv_to_rgb(hsv).to(flow.dtype)
