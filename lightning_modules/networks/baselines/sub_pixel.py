"""Sub-pixel upsampling: convolution and pixel shuffle."""

from __future__ import annotations

from torch import nn

from lightning_modules.networks.layers import conv


def sub_pixel_convolutions(width: int, scale: int, *after: nn.Module) -> nn.Sequential:
    """A convolution and a pixel shuffle for every prime factor of the scale: (B, width, H, W) to (B, width, s H, s W).

    Example:
        >>> [layer.upscale_factor for layer in sub_pixel_convolutions(8, 6)[1::2]]
        [2, 3]

    Reference:
        Shi et al., Real-time single image and video super-resolution, CVPR 2016.
    """
    layers: list[nn.Module] = []
    factor = 2
    while scale > 1:
        while scale % factor == 0:
            layers += [conv(width, factor**2 * width), nn.PixelShuffle(factor), *after]
            scale //= factor
        factor += 1
    return nn.Sequential(*layers)
