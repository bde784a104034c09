"""Image encoding: PNG and animated GIF as bytes."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spikekit.arguments import one_line
from spikekit.io.quiet import quiet


class PictureError(ValueError):
    """A picture that cannot be read or written; the message is one line and names the file."""


def to_bytes(image: Tensor) -> Tensor:
    """Round an image (*, 3, H, W) or (H, W) in [0, 1] to 8 bits, clamped, NaN being black: (*, H, W, 3) or (H, W).

    One that has 8 bits already keeps them.
    """
    pixels = image.detach().cpu()
    if pixels.dtype != torch.uint8:
        pixels = pixels.float().nan_to_num(0).clamp_(0, 1).mul_(255).round_().to(torch.uint8)
    return pixels if pixels.ndim == 2 else pixels.movedim(-3, -1).contiguous()


def png_bytes(image: Tensor, notes: Mapping[str, str] | None = None) -> bytes:
    """Return the PNG file of an image.

    Args:
        image: (3, H, W) or (H, W), floating, [0, 1], or uint8.
        notes: texts that stand in front of the pixels, by name; :func:`png_notes` reads them.

    Returns:
        The bytes of the file.

    Example:
        >>> png_bytes(torch.zeros(3, 4, 6))[1:4]
        b'PNG'
    """
    from PIL.PngImagePlugin import PngInfo

    said = PngInfo()
    for name, text in (notes or {}).items():
        said.add_text(name, text)
    return picture_bytes(image, ".png", pnginfo=said)


def png_notes(path: str | Path) -> dict[str, str]:
    """Return the texts in front of the pixels of a PNG file, none where it cannot be read; the pixels are not read."""
    from PIL import Image

    try:
        with quiet(), Image.open(path, formats=["PNG"]) as picture:
            return {name: text for name, text in picture.info.items() if isinstance(text, str)}
    except Exception:
        return {}


def png_pixels(path: str | Path) -> Tensor:
    """Return the pixels of a PNG file of 8 bits, (3, H, W), uint8: a quarter of the memory of a picture.

    Raises:
        PictureError: the file cannot be read.
    """
    from PIL import Image

    try:
        with quiet(), Image.open(path, formats=["PNG"]) as picture:
            return torch.from_numpy(np.array(picture.convert("RGB"))).movedim(-1, 0)
    except Exception as error:
        raise PictureError(f"{path}: not a picture that can be read ({one_line(error)})") from error


def picture_bytes(image: Tensor, ending: str, **how: Any) -> bytes:
    """Return the file of an image.

    Args:
        image: (3, H, W) or (H, W), floating, [0, 1].
        ending: names the format, such as ``".png"``.
        how: more arguments of Pillow.

    Returns:
        The bytes of the file.

    Raises:
        ValueError: no format that Pillow writes has this ending.

    Example:
        >>> picture_bytes(torch.zeros(3, 4, 6), ".JPG")[:2].hex()
        'ffd8'
    """
    from PIL import Image

    formats = {name: kind for name, kind in Image.registered_extensions().items() if kind in Image.SAVE}
    if ending.lower() not in formats:
        raise ValueError(f"expected a name that ends like that of a picture, such as .png, got {ending or 'no ending'}")
    file = io.BytesIO()
    # of PNG: a fifth of the time of Pillow's own level 6, for files that are 15 % longer
    Image.fromarray(to_bytes(image).numpy()).save(file, formats[ending.lower()], compress_level=2, **how)
    return file.getvalue()


def gif_bytes(images: Iterable[Tensor], seconds: float) -> bytes:
    """Return an animated GIF that begins again at its end.

    Args:
        images: (3, H, W) or (H, W) each, of one size, floating, [0, 1].
        seconds: how long each is shown; a GIF counts in hundredths, from 0.02 to 655.35.

    Returns:
        The bytes of the file.

    Example:
        >>> gif_bytes([torch.zeros(4, 6), torch.ones(4, 6)], 0.1)[:3]
        b'GIF'
    """
    from PIL import Image

    first, *others = (Image.fromarray(to_bytes(image).numpy()) for image in images)
    file = io.BytesIO()
    duration = round(min(max(1000 * seconds, 20), 655_350))
    first.save(file, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    return file.getvalue()
