"""TSCNN on one decoded mosaic, the paper's "TFI + TSCNN" and "TFP + TSCNN"."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightning_modules.motion import ZeroFlow
from lightning_modules.networks.baselines.parts import (
    Baseline,
    Decoder,
    begin_at_zero,
    check_decoder,
    decode_pictures,
    enlarge_picture,
    mirror_to_multiple,
    whole_sizes,
)
from lightning_modules.networks.layers import ConvBlock, ResBlock, conv
from lightning_modules.signatures import inherit_signature
from spikekit import bayer_mask, demosaic_residual

_SQUEEZED = 4  # hidden channels of a channel attention
_ATTENTIONS = 3  # attention blocks per group


class TSCNN(Baseline):
    r"""TSCNN, two stages on the mosaic of the middle frame: demosaicing, then super-resolution.

    As published, and as in the public code, of which nothing is copied: all layers, their widths and connections, and
    so the number of parameters. Differences: the mosaic is TFI or TFP of the middle frame, in [0, 1] instead of
    [0, 255]; :func:`spikekit.demosaic_residual` replaces MLRI; any Bayer phase is accepted; ``skip`` is optional; the
    training is that of all networks here. The original uses mean squared error, Adam at 2e-4 and batches of 64, for 500
    epochs. Two details are not documented and chosen here: no activation follows the 3 x 3 convolutions of the first
    stage, and the global skip begins at the first convolution of the second stage.

    Args:
        scale, frames, pattern, alpha: see :class:`Baseline`.
        decoder: ``"tfi"``, or ``"tfp"``, which averages 41 frames.
        width: channels, a multiple of 8.
        blocks: parallel octave residual dense blocks; 3 for TSCNN-L, 4 for TSCNN-H.
        low: groups of attention blocks at half the resolution, in each of a block's two rounds; 2 or 4.
        high: groups of attention blocks at full resolution, in each round; 3 or 6.
        skip: predict a residual, which is added to the demosaiced and bicubically enlarged picture, so that training
            starts from the result of demosaicing. The publication has no such skip.

    Shape:
        - Input: spikes :math:`(B, N, H, W)` of any real dtype, with H and W of at least 3; the flow is ignored
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Raises:
        ValueError: the decoder is unknown, a size is below 1, or the width is not a multiple of 8.

    Example:
        >>> network = TSCNN(scale=2, decoder="tfp", width=8, blocks=1, low=1, high=1)
        >>> network(torch.zeros(1, 41, 12, 9)).shape
        torch.Size([1, 3, 24, 18])

    Reference:
        Guo et al., joint demosaicing and super-resolution by a two-stage network (TSCNN), IEEE TCSVT 2021.
    """

    halo = None  # channel attention pools over the whole picture
    takes_flow = False

    @inherit_signature(Baseline, "more", "motion")
    def __init__(
        self,
        *args: Any,
        decoder: Decoder = "tfi",
        width: int = 64,
        blocks: int = 3,
        low: int = 2,
        high: int = 3,
        skip: bool = False,
        **common: Any,
    ) -> None:
        sizes = whole_sizes(width=width, blocks=blocks, low=low, high=high)
        check_decoder(decoder)
        if width % 8:
            raise ValueError(f"width: expected a multiple of 8, got {width}")
        super().__init__(*args, **common, motion=ZeroFlow(), more={"decoder": decoder, **sizes, "skip": skip})
        self.decoder, self.skip = decoder, skip
        self.colors = DemosaicingStage(width)
        self.first, self.second = conv(3, width), conv(width, width)
        self.blocks = nn.ModuleList(OctaveBlock(width, low, high) for _ in range(blocks))
        self.fuse = nn.Sequential(nn.Conv2d(blocks * width, width, 1), conv(width, width))
        self.upsample = nn.Sequential(conv(width, 3 * self.scale**2), nn.PixelShuffle(self.scale))
        if skip:
            begin_at_zero(self.upsample[0])

    def forward(self, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:
        """Return rgb; the flow is ignored."""
        self.check_spikes(spikes)
        height, width = spikes.shape[-2:]
        raw = decode_pictures(spikes, [self.frames // 2], self.alpha, self.decoder)
        raw = mirror_to_multiple(raw.to(self.first.weight.dtype), 2)
        picture = demosaic_residual(raw[:, 0], self.pattern)
        mask = bayer_mask(*raw.shape[-2:], self.pattern, device=raw.device, dtype=raw.dtype)
        shallow = self.first(self.colors(raw, mask) + picture)
        features = self.second(shallow)
        deep = self.fuse(torch.cat([block(features) for block in self.blocks], dim=1))
        rgb = self.upsample(shallow + deep).to(picture)
        if self.skip:
            rgb = rgb + enlarge_picture(picture, self.scale)
        return rgb[..., : self.scale * height, : self.scale * width]


class DemosaicingStage(nn.Module):
    """Residual of the demosaiced picture (B, 3, H, W), from the mosaic (B, 1, H, W) and the colour masks (3, H, W)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        half = width // 2
        self.seen = nn.ModuleList(KnownPixels(channels) for channels in (half, width, half))
        self.green = nn.Sequential(nn.Conv2d(2 * width, half, 1), nn.ReLU(inplace=True), ResBlock(half), ResBlock(half))
        self.guides = nn.ModuleList(nn.Conv2d(half, width, 1) for _ in range(2))
        self.others = nn.ModuleList(
            nn.Sequential(nn.Conv2d(half + width, half, 1), nn.ReLU(inplace=True), ResBlock(half)) for _ in range(2)
        )
        self.planes = nn.ModuleList(nn.Conv2d(half, 1, 1) for _ in range(3))

    def forward(self, raw: Tensor, mask: Tensor) -> Tensor:  # noqa: D102
        seen = [see(raw, known) for see, known in zip(self.seen, mask, strict=True)]
        green = self.green(torch.cat(seen, dim=1))
        red, blue = (
            other(torch.cat([own, guide(green)], dim=1))
            for other, own, guide in zip(self.others, seen[::2], self.guides, strict=True)
        )
        return torch.cat([plane(color) for plane, color in zip(self.planes, (red, green, blue), strict=True)], dim=1)


class KnownPixels(nn.Module):
    """Features of one colour's pixels: a convolution normalised by the number of known pixels, and another one."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.partial = nn.Conv2d(1, channels, 5, padding=2, bias=False)
        self.norm = nn.BatchNorm2d(channels)
        self.conv = conv(channels, channels)

    def forward(self, raw: Tensor, mask: Tensor) -> Tensor:  # noqa: D102
        known = F.avg_pool2d(mask[None, None], 5, 1, 2).mul(25).round()  # ONNX ignores a divisor
        features = self.partial(raw * mask) / known.clamp(min=1)
        return self.conv(self.norm(features).relu())


class OctaveBlock(nn.Module):
    """Two rounds of attention at two resolutions, a quarter of the channels at the lower, (B, C, H, W) to the same."""

    def __init__(self, width: int, low: int, high: int) -> None:
        super().__init__()
        few, many = width // 4, width - width // 4
        self.to_low = nn.Conv2d(width, few, 3, stride=2, padding=1)
        self.to_high = conv(width, many)
        self.low = nn.ModuleList(DenseGroups(few, low) for _ in range(2))
        self.high = nn.ModuleList(DenseGroups(many, high) for _ in range(2))
        self.rise = nn.ModuleList(nn.Sequential(nn.Conv2d(few, 4 * few, 1), nn.PixelShuffle(2)) for _ in range(2))
        self.join = nn.ModuleList([nn.Conv2d(width, many, 1), nn.Conv2d(width, width, 1)])

    def forward(self, features: Tensor) -> Tensor:  # noqa: D102
        low, high = self.to_low(features), self.to_high(features)
        for think_low, think_high, rise, join in zip(self.low, self.high, self.rise, self.join, strict=True):
            low, high = think_low(low), think_high(high)
            high = join(torch.cat([high, rise(low)], dim=1))
        return high


class DenseGroups(nn.Module):
    """Densely connected groups of attention blocks, joined by 1 x 1 convolutions, plus the input."""

    def __init__(self, width: int, groups: int) -> None:
        super().__init__()
        self.groups = nn.ModuleList(
            nn.Sequential(*(AttentionBlock(width) for _ in range(_ATTENTIONS))) for _ in range(groups)
        )
        self.fuse = nn.ModuleList(nn.Conv2d((n + 2) * width, width, 1) for n in range(groups))

    def forward(self, features: Tensor) -> Tensor:  # noqa: D102
        made, fused = [features], features
        for group, fuse in zip(self.groups, self.fuse, strict=True):
            made.append(group(fused))
            fused = fuse(torch.cat(made, dim=1))
        return features + fused


class AttentionBlock(nn.Module):
    """Two parallel bottlenecks, whose sum is weighted by channel attention, plus the input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        half = width // 2
        self.ways = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(width, half, 1), nn.ReLU(inplace=True), ConvBlock(half, half), nn.Conv2d(half, width, 1)
            )
            for _ in range(2)
        )
        self.attend = nn.Sequential(
            nn.AdaptiveAvgPool2d(1),
            nn.Conv2d(width, _SQUEEZED, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(_SQUEEZED, width, 1),
            nn.Sigmoid(),
        )

    def forward(self, features: Tensor) -> Tensor:  # noqa: D102
        change = self.ways[0](features) + self.ways[1](features)
        return features + change * self.attend(change)
