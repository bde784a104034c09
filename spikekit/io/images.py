"""Image files: read pictures, write PNG, lay out panels, colour-code flow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from kornia.color import hsv_to_rgb
from torch import Tensor

from spikekit.arguments import one_line
from spikekit.check import check_picture, check_planes, check_positive
from spikekit.io.image_bytes import PictureError, picture_bytes
from spikekit.io.quiet import quiet
from spikekit.io.whole_file import whole_file

#: Pixels of the largest picture that is read: a few bytes can claim more than there is memory.
MOST_PIXELS = 1 << 27

_FARTHEST = 1e9  # the length of what is infinite


def read_picture(path: str | Path) -> Tensor:
    """Read a picture file as a colour image.

    Grey pictures get three equal channels, 16-bit files keep their depth (where they are grey, or RGB with or without
    alpha). Alpha is laid over white, as a page shows it; dropping it would bring up colours that nobody was meant to
    see, and where it is opaque it changes nothing. Values stay gamma-encoded as in the file.

    Args:
        path: a PNG, JPEG, TIFF (its first page) or any other file that Pillow reads.

    Returns:
        ``rgb`` of shape (3, H, W), float32, in [0, 1].

    Raises:
        FileNotFoundError: there is no such file.
        PictureError: the file is not a picture that can be read, or has more than 2^27 pixels.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_picture(f"{folder}/grey.png", torch.full((4, 6), 0.2))
        ...     read_picture(f"{folder}/grey.png").shape
        torch.Size([3, 4, 6])
    """
    from skimage import color, util

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such picture")
    try:
        with quiet():
            pixels = util.img_as_float32(_pixels(path))
        if pixels.ndim == 3 and pixels.shape[-1] == 4:
            pixels = color.rgba2rgb(pixels)
        elif pixels.ndim == 2 or pixels.shape[-1] == 1:
            pixels = color.gray2rgb(pixels.reshape(pixels.shape[:2]))
    except Exception as error:
        said = one_line(error).removeprefix(f"{path}: ")[:300]
        raise PictureError(f"{path}: not a picture that can be read ({said})") from error
    if pixels.ndim != 3 or pixels.shape[-1] != 3 or 0 in pixels.shape:
        raise PictureError(f"{path}: expected a grey or colour picture, got an array of shape {pixels.shape}")
    return torch.from_numpy(pixels.astype("float32")).permute(2, 0, 1).contiguous()


def _pixels(path: str | Path) -> np.ndarray:
    """Read the numbers of a file: (H, W), (H, W, 3) or (H, W, 4), red first, alpha last, in its own depth.

    By what the file says that it is, and by one library each: one that tries others would hand what no picture is to
    FFmpeg, for which some files are lists of others to open.
    """
    from PIL import Image

    with open(path, "rb") as file:
        head = file.read(26)
    if head[:2] in (b"II", b"MM"):
        return _tiff_pixels(path)
    with Image.open(path) as picture:
        _check_pixels(picture.height * picture.width)
        if head.startswith(b"\x89PNG") and head[24:] in (b"\x10\x02", b"\x10\x06"):
            # 16 bits in colour, of which Pillow would keep 8
            from kornia_rs.io import read_image_png_u16

            return read_image_png_u16(str(path), "rgb" if head[25] == 2 else "rgba")
        if picture.mode == "I" and picture.format == "PNG":  # 16 bits, as older versions of Pillow say it
            return np.asarray(picture).astype(np.uint16)
        if picture.mode in ("1", "L", "I", "F", "RGB", "RGBA") or picture.mode.startswith("I;16"):
            return np.asarray(picture)
        return np.asarray(picture.convert("RGBA" if picture.has_transparency_data else "RGB"))


def _tiff_pixels(path: str | Path) -> np.ndarray:
    """Read the first page of a TIFF."""
    from PIL import Image
    from tifffile import TiffFile

    with suppress(OSError, SyntaxError), Image.open(path) as picture:
        if picture.mode in ("P", "PA", "LA", "CMYK", "YCbCr", "LAB"):
            _check_pixels(picture.height * picture.width)
            return np.asarray(picture.convert("RGBA" if picture.has_transparency_data else "RGB"))
    with TiffFile(path) as file:
        page = file.pages.first
        _check_pixels(max(math.prod(page.shape), math.prod(page.chunks)) / 4)  # of up to four channels
        return page.asarray()


def _check_pixels(count: float) -> None:
    if count > MOST_PIXELS:
        raise ValueError(f"expected at most {MOST_PIXELS} pixels, got {count:.0f}")


def write_picture(path: str | Path, image: Tensor) -> None:
    """Write an image to a file; the folder is made when it is missing.

    Args:
        path: where to; the ending names the format, PNG for lossless.
        image: (3, H, W) or (H, W), floating, [0, 1]; clamped, and rounded to 8 bits; NaN is black.

    Raises:
        TypeError: ``image`` is not a floating-point tensor.
        ValueError: ``image`` has another shape, or the ending is of no format.
        OSError: the file cannot be written; what was there before, or nothing, is then there.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_picture(f"{folder}/new/red.png", torch.tensor([1.2, 0.0, -0.1]).reshape(3, 1, 1))
        ...     read_picture(f"{folder}/new/red.png").flatten().tolist()
        [1.0, 0.0, 0.0]
    """
    check_picture("image", image, "(3, H, W) or (H, W)", grey=True)
    data = picture_bytes(image, Path(path).suffix)
    with whole_file(path) as file:
        file.write(data)


def panel(rows: Sequence[Sequence[Tensor]], gap: int = 4) -> Tensor:
    """Lay pictures out in rows and columns on white.

    Args:
        rows: pictures (3, H, W), (1, H, W) or (H, W); rows may differ in length, pictures in size.
        gap: white pixels between two pictures.

    Returns:
        One picture (3, H, W), float32, on the CPU; every picture stands at the top left of its cell.

    Raises:
        TypeError: a picture that is not a tensor of real numbers.
        ValueError: no rows, a row without a picture, or a picture of another shape.

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
    sheet = torch.ones(3, sum(heights) + gap * (len(heights) - 1), sum(widths) + gap * (len(widths) - 1))
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
    r"""Show flow as colour: the direction is the hue, the length is the saturation, white stands still.

    .. math:: \text{hue} = \operatorname{atan2}(v, u), \quad \text{saturation} = \min(1, \sqrt{u^2 + v^2} / l)

    Convention:
        Flow in pixels, order (x, y), x right, y down. Red points right, and the hue turns clockwise on the screen.
        NaN flow counts as 0, infinite flow as very far. Made for the eye: the gradient at zero flow is NaN.

    Args:
        flow: :math:`(*, 2, H, W)`, floating.
        max_flow: l, the length that is fully saturated, above 0; the longest of the tensor when not given.

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
    hue = torch.atan2(y, x).remainder(2 * math.pi)
    hsv = torch.stack([hue, (length / max_flow).clamp(max=1), torch.ones_like(length)], dim=-3)
    return hsv_to_rgb(hsv).to(flow.dtype)
