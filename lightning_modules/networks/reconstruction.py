"""Reconstruction from the features of three colours: CCR, and the ablations H and I (Fig. 6)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightning_modules.networks.layers import NoiseLevel, conv, res_blocks


class ToRgb(nn.Conv2d):
    """Sub-pixel convolution to the colours, never in half precision, which would round the picture itself."""

    def __init__(self, inputs: int, enlarge: int = 1, groups: int = 1, colors: int = 3) -> None:
        super().__init__(inputs, colors * enlarge**2, 3, padding=1, groups=groups)
        self.enlarge = enlarge

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        with torch.autocast(x.device.type, enabled=False):
            return F.pixel_shuffle(super().forward(x.to(self.weight.dtype)), self.enlarge)


class ColorFusion(nn.Sequential):
    """3 x 3 convolution and LeakyReLU: everything passes through here, and must not die as with a ReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(conv(inputs, outputs), nn.LeakyReLU(0.1, inplace=True))


class ColorCorrelation(nn.Module):
    """CCR (section 4.4, Fig. 6 a): the colours are refined side by side and fused after every stage.

    A single colour, of a grey sensor, has as many residual blocks, and one fusion behind them.

    Args:
        width: channels, of every colour and inside.
        stages: how often the colours are fused.
        blocks: residual blocks of every colour in every stage.
        end_blocks: residual blocks after the last fusion.
        enlarge: how many times larger the picture is than the features.
        end_width: channels after the last fusion; when not given, ``width``.
        colors: how many there are.
        noise: be told the level of the sensor's noise.

    Shape:
        - Input: features of every colour, each :math:`(B, width, H, W)`; perhaps the level of the noise,
          :math:`(B, 1, 1, 1)`
        - Output: rgb :math:`(B, colors, enlarge H, enlarge W)`
    """

    def __init__(
        self,
        width: int,
        stages: int,
        blocks: int,
        end_blocks: int,
        enlarge: int = 1,
        end_width: int | None = None,
        colors: int = 3,
        noise: bool = False,
    ) -> None:
        super().__init__()
        end_width = end_width or width
        if colors == 1:
            stages, blocks = 1, stages * blocks
        self.refine = nn.ModuleList(
            nn.ModuleList(res_blocks(width, blocks) for _ in range(colors)) for _ in range(stages)
        )
        inputs = [colors * width] + [(colors + 1) * width] * (stages - 1)
        outputs = [width] * (stages - 1) + [end_width]
        self.fuse = nn.ModuleList(map(ColorFusion, inputs, outputs))
        self.noise = NoiseLevel(end_width) if noise else None
        self.end = res_blocks(end_width, end_blocks)
        self.rgb = ToRgb(end_width, enlarge, colors=colors)

    def features(self, colors: list[Tensor], noise: Tensor | None = None) -> Tensor:
        """Features of all colours that the picture is made of, (B, end_width, H, W)."""
        fused: list[Tensor] = []
        for refine, fuse in zip(self.refine, self.fuse, strict=True):
            colors = [branch(color) for branch, color in zip(refine, colors, strict=True)]
            fused = [fuse(torch.cat(colors + fused, dim=1))]
        known = fused[0] if noise is None else self.noise(fused[0], noise)
        return known + self.end(known)

    def forward(self, colors: list[Tensor], noise: Tensor | None = None) -> Tensor:  # noqa: D102
        return self.rgb(self.features(colors, noise))


class SeparateColors(nn.Module):
    """No colour correlation (Fig. 6 b, ablation H): every colour makes its own channel of the picture.

    The number of residual blocks is that of :class:`ColorCorrelation`, the last ones shared out and rounded up.
    """

    def __init__(self, width: int, stages: int, blocks: int, end_blocks: int, enlarge: int = 1) -> None:
        super().__init__()
        self.refine = nn.ModuleList(res_blocks(width, stages * blocks) for _ in range(3))
        self.end = nn.ModuleList(res_blocks(width, -(-end_blocks // 3)) for _ in range(3))
        self.rgb = ToRgb(3 * width, enlarge, groups=3)

    def forward(self, colors: list[Tensor]) -> Tensor:  # noqa: D102
        colors = [refine(color) for refine, color in zip(self.refine, colors, strict=True)]
        colors = [color + end(color) for end, color in zip(self.end, colors, strict=True)]
        return self.rgb(torch.cat(colors, dim=1))


class EarlyFusion(nn.Module):
    """Colours fused once, at the beginning (Fig. 6 c, ablation I), and as many blocks as :class:`ColorCorrelation`."""

    def __init__(
        self, width: int, stages: int, blocks: int, end_blocks: int, enlarge: int = 1, end_width: int | None = None
    ) -> None:
        super().__init__()
        end_width = end_width or width
        self.fuse = ColorFusion(3 * width, end_width)
        self.refine = res_blocks(end_width, 3 * stages * blocks + end_blocks)
        self.rgb = ToRgb(end_width, enlarge)

    def forward(self, colors: list[Tensor]) -> Tensor:  # noqa: D102
        fused = self.fuse(torch.cat(colors, dim=1))
        return self.rgb(fused + self.refine(fused))
