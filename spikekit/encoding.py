"""Pictures as bytes: PNG, and animated GIF."""

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
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(to_bytes(image).numpy()).save(file, "PNG")
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
