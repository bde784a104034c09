"""Image encoding: PNG and animated GIF as bytes."""

from __future__ import annotations

import io
from collections.abc import Iterable

import torch
from torch import Tensor


def to_bytes(image: Tensor) -> Tensor:
    """Round an image (*, 3, H, W) or (H, W) in [0, 1] to 8 bits, clamped, NaN being black: (*, H, W, 3) or (H, W)."""
    pixels = (image.detach().float().cpu().nan_to_num(0).clamp(0, 1) * 255).round().to(torch.uint8)
    return pixels if pixels.ndim == 2 else pixels.movedim(-3, -1).contiguous()


def png_bytes(image: Tensor) -> bytes:
    """Return the PNG file of an image.

    Args:
        image: (3, H, W) or (H, W), floating, [0, 1].

    Returns:
        The bytes of the file.

    Example:
        >>> png_bytes(torch.zeros(3, 4, 6))[1:4]
        b'PNG'
    """
    return picture_bytes(image, ".png")


def picture_bytes(image: Tensor, ending: str) -> bytes:
    """Return the file of an image.

    Args:
        image: (3, H, W) or (H, W), floating, [0, 1].
        ending: names the format, such as ``".png"``.

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
    Image.fromarray(to_bytes(image).numpy()).save(file, formats[ending.lower()], compress_level=2)
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
