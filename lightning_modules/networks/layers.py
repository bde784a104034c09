"""Building blocks of CSCSR."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def channels_last(planes: Tensor) -> Tensor:
    """(B, C, H, W) with its channels side by side in memory, the layout in which convolutions are faster."""
    return planes.contiguous(memory_format=torch.channels_last)


def enlarge(features: Tensor, scale: int) -> Tensor:
    """Bilinear: (*, C, H, W) to (*, C, s H, s W)."""
    if scale == 1:
        return features
    planes = features.reshape(-1, *features.shape[-3:])
    planes = F.interpolate(planes, scale_factor=scale, mode="bilinear", align_corners=False)
    return planes.reshape(*features.shape[:-2], *planes.shape[-2:])


def fold(planes: Tensor, size: int) -> Tensor:
    """(B, C, size H, size W) to (B, C size^2, H, W) as ``pixel_unshuffle`` and :func:`channels_last` in one copy."""
    batch, channels, height, width = planes.shape
    blocks = planes.reshape(batch, channels, height // size, size, width // size, size).permute(0, 2, 4, 1, 3, 5)
    return channels_last(blocks.flatten(3).movedim(-1, 1))


def conv(inputs: int, outputs: int) -> nn.Conv2d:
    """3 x 3 convolution that keeps the size."""
    return nn.Conv2d(inputs, outputs, 3, padding=1)


class ConvBlock(nn.Sequential):
    """3 x 3 convolution and ReLU (Fig. 4)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(conv(inputs, outputs), nn.ReLU(inplace=True))


class ResBlock(nn.Module):
    """Convolution, activation, convolution, plus the input: a residual block without normalisation."""

    def __init__(self, width: int, activation: nn.Module | None = None) -> None:
        super().__init__()
        self.body = nn.Sequential(conv(width, width), activation or nn.ReLU(inplace=True), conv(width, width))

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        return x + self.body(x)


def res_blocks(width: int, count: int) -> nn.Sequential:
    """Residual blocks one after another."""
    return nn.Sequential(*(ResBlock(width) for _ in range(count)))


class NoiseLevel(nn.Module):
    """What the level of the sensor's noise changes: gain and shift of every channel, nothing at level 0.

    One layer of FiLM (Perez et al., AAAI 2018), linear in the level. Before it is trained it changes nothing.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.zeros(width, 1, 1))
        self.shift = nn.Parameter(torch.zeros(width, 1, 1))

    def forward(self, features: Tensor, level: Tensor | None) -> Tensor:  # noqa: D102
        return features if level is None else features * (1 + level * self.gain) + level * self.shift


def start_pixel_by_pixel(part: nn.Module) -> None:
    """Initialize convolutions: orthogonal centre taps, small ones around (Xiao et al., ICML 2018).

    A dozen random 3 x 3 filters in a row would blur what the network is to sharpen: training then rests for
    hundreds of steps on a plateau, or dies on it.
    """
    for module in part.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            module.weight.data *= 0.2
            module.weight.data[:, :, 1, 1] += nn.init.orthogonal_(torch.empty(module.weight.shape[:2]), gain=1.2)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    for module in part.modules():
        if isinstance(module, ResBlock):
            module.body[-1].weight.data *= 0.1
