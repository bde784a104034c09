"""Image encoding to bytes."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zlib import Z_HUFFMAN_ONLY

import numpy as np
import torch
from torch import Tensor

from spikekit.arguments import one_line
from spikekit.io.quiet import quiet


class PictureError(ValueError):
    """An unreadable picture; the message is one line and names the file."""


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
