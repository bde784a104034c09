"""Reconstruction from the features of the colours: CCR, and the ablations H and I (Fig. 6)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightning_modules.networks.layers import ConvBlock, NoiseLevel, conv, res_blocks


class ToRgb(nn.Conv2d):
    """Convolution to the colours of all sub-pixels; half precision would round the picture, so it disables autocast."""

    def __init__(self, inputs: int, enlarge: int = 1, groups: int = 1, colors: int = 3) -> None:
        super().__init__(inputs, colors * enlarge**2, 3, padding=1, groups=groups)

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


class ColorFusion(nn.Sequential):
    """3 x 3 convolution and LeakyReLU; all features pass through here, so a dying ReLU would be fatal."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(conv(inputs, outputs), nn.LeakyReLU(0.1, inplace=True))


class ColorCorrelation(nn.Module):
    """CCR (section 4.4, Fig. 6 a): parallel refinement of the colours, with a fusion after every stage.

    The single colour of a grey sensor has the same number of residual blocks, followed by one fusion.

    Args:
        width: channels per colour and between stages.
        stages: number of fusions.
        blocks: residual blocks per colour and stage.
        end_blocks: residual blocks after the last fusion.
        enlarge: size of the picture relative to the features.
        end_width: channels after the last fusion. Default: ``width``.
        colors: number of colours, 3, or 1 for a grey sensor.
        noise: the noise level of the sensor changes gain and shift of the fused features.
        noise_blocks: residual blocks that correct the features in proportion to the noise level.

    Shape:
        - Input: features of each colour, :math:`(B, width, H, W)`; optionally the noise level, :math:`(B, 1, 1, 1)`
        - Output: rgb with its sub-pixels as channels, :math:`(B, colors enlarge^2, H, W)`
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
        noise_blocks: int | None = None,
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
        self.correction = res_blocks(end_width, noise_blocks) if noise_blocks else None
        self.end = res_blocks(end_width, end_blocks)
        self.rgb = ToRgb(end_width, enlarge, colors=colors)

    def features(self, colors: list[Tensor], noise: Tensor | None = None) -> Tensor:
        """Return the fused features before the last convolution, (B, end_width, H, W)."""
        fused: list[Tensor] = []
        for refine, fuse in zip(self.refine, self.fuse, strict=True):
            colors = [branch(color) for branch, color in zip(refine, colors, strict=True)]
            fused = [fuse(torch.cat(colors + fused, dim=1))]
        known = fused[0] if self.noise is None else self.noise(fused[0], noise)
        found = known + self.end(known)
        corrected = noise is not None and self.correction is not None
        return found + noise * (self.correction(known) - known) if corrected else found

    def forward(self, colors: list[Tensor], noise: Tensor | None = None) -> Tensor:  # noqa: D102
        return self.rgb(self.features(colors, noise))


class SeparateColors(nn.Module):
    """Reconstruction of each colour channel independently (Fig. 6 b, ablation H).

    The number of residual blocks is that of :class:`ColorCorrelation`; ``end_blocks`` are divided among the colours and
    rounded up.
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
    """Reconstruction with one fusion at the beginning (Fig. 6 c, ablation I), as deep as :class:`ColorCorrelation`."""

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


def _packed(planes: Tensor) -> Tensor:
    """Pack cells of 2 x 2 pixels, (B, C, 2 H, 2 W) to (B, 4 C, H, W), channels last, pixel after pixel."""
    cells = planes.unflatten(3, (-1, 2)).unflatten(2, (-1, 2))
    return cells.permute(0, 2, 4, 3, 5, 1).flatten(3).movedim(-1, 1)


class CellReconstruction(nn.Module):
    """Reconstruction without motion, at half the resolution of the sensor, with all spikes of 2 x 2 pixels as channels.

    Chen et al. pack raw pictures in this way (Learning to See in the Dark, CVPR 2018). The result is a linear function
    of a TFP picture plus a residual.

    Args:
        frames: spike frames per clip, N.
        width: channels.
        blocks: residual blocks.
        enlarge: size of the picture relative to the cells.
        colors: number of colours, 3, or 1 for a grey sensor.
        noise: the noise level of the sensor changes gain and shift of the first features.

    Shape:
        - Input: spikes :math:`(B, N, 2 H, 2 W)`, with red at (0, 0); their TFP picture, :math:`(B, 1, 2 H, 2 W)`;
          optionally the noise level, :math:`(B, 1, 1, 1)`
        - Output: rgb with its sub-pixels as channels, :math:`(B, colors enlarge^2, H, W)`
    """

    def __init__(
        self, frames: int, width: int, blocks: int, enlarge: int, colors: int = 3, noise: bool = False
    ) -> None:
        super().__init__()
        self.colors = colors
        self.begin = ConvBlock(4 * frames, width)
        self.noise = NoiseLevel(width) if noise else None
        self.end = res_blocks(width, blocks)
        self.rgb = conv(width, colors * enlarge**2)
        self.base = nn.Conv2d(4, colors * enlarge**2, 3, padding=1, padding_mode="replicate", bias=False)

    @torch.no_grad()
    def start_at_the_mean(self) -> None:
        """Initialise the first channels as firing rates, and the picture as the mean of each colour in a cell."""
        weight = self.begin[0].weight.unflatten(1, (4, -1))
        frames = weight.shape[2]
        weight *= 0.3
        for channel in range(min(12, len(weight))):
            near = max(1, frames // 3 ** (channel // 4))
            first = (frames - near) // 2
            weight[channel] = 0
            weight[channel, channel % 4, first : first + near, 1, 1] = 1 / near
        self.rgb.weight *= 0.01
        nn.init.zeros_(self.base.weight)
        own = torch.full((1, 4), 0.25)
        if self.colors > 1:
            own = torch.tensor([[1, 0, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0, 1]])
        self.base.weight[..., 1, 1] = own.repeat_interleave(len(self.base.weight) // self.colors, dim=0)

    def forward(self, spikes: Tensor, planes: Tensor, noise: Tensor | None = None) -> Tensor:  # noqa: D102
        cells = _packed(spikes)
        seen = self.begin(cells if cells.is_floating_point() else cells.to(planes.dtype))
        seen = seen if self.noise is None else self.noise(seen, noise)
        residual = self.rgb(self.end(seen))
        with torch.autocast(spikes.device.type, enabled=False):  # half precision would round the picture
            return self.base(_packed(planes)) + residual
