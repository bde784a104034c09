"""Stand-in for SpikeSR-Net, whose code and text are not public."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from lightning_modules.motion import ZeroFlow
from lightning_modules.networks.baselines.parts import (
    Baseline,
    DeformableConv2d,
    begin_at_zero,
    decode_pictures,
    enlarged_raw,
    run_per_channel,
    sub_pixel_convolutions,
    whole_sizes,
)
from lightning_modules.networks.layers import ConvBlock, conv, res_blocks
from lightning_modules.signatures import inherit_signature
from spikekit import split_colors

_LENGTH = 13  # spike frames per representation
_EVERY = 7  # spike frames between two representations


class SpikeSRNetLike(Baseline):
    r"""SpikeSR-Net (Zhao et al., AAAI 2023), for grey spike cameras, as far as it is published.

    As published, according to the abstract and to figures in later papers: a pixel-adaptive spike encoder turns the
    stream into representations at several times; a resolver, guided by the observation model, aligns them and uses
    them repeatedly; at x4 the grey network has 3.34 million weights.

    The details are this project's own: windows of 13 spike frames, 7 apart; 16 predicted kernels per pixel over the
    spikes of a window; deformable alignment to the middle representation, with offsets from both; four corrections of
    the picture's features by the enlarged difference between the mean of the aligned representations and the shrunk
    features. The 16 filtered maps are split into three colour planes with zeros at other pixels, so that convolutions
    can tell the colours apart. The network needs no flow. A ``width`` of 32 with 12 ``maps`` takes as much work as
    CSCSR's size small, and so does 24 with 8 ``per_channel``.

    Offsets are unbounded, so the network does not run in tiles.

    Args:
        scale, frames, pattern, alpha: see :class:`Baseline`; ``frames`` is 13 plus a multiple of 14, so that one
            representation is centred on the middle frame.
        width: channels, a multiple of 8.
        maps: number of kernels per pixel.
        corrections: number of corrections of the picture's features.
        per_channel: reconstruct each Bayer sub-stream separately, as the paper's SpikeSR-Net with a star.
        skip: predict a residual, which is added to the demosaiced and bicubically enlarged TFI picture, so that
            training starts from the result of the decoder.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, zeros and ones of any real dtype; the flow is ignored
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Example:
        >>> SpikeSRNetLike(scale=2, width=8, maps=2, corrections=1)(torch.zeros(1, 41, 8, 6)).shape
        torch.Size([1, 3, 16, 12])
    """

    takes_flow = False

    @inherit_signature(Baseline, "more", "motion")
    def __init__(
        self,
        *args: Any,
        width: int = 64,
        maps: int = 16,
        corrections: int = 4,
        per_channel: bool = False,
        skip: bool = False,
        **common: Any,
    ) -> None:
        more = whole_sizes(width=width, maps=maps, corrections=corrections)
        more |= {"per_channel": per_channel, "skip": skip}
        super().__init__(*args, **common, motion=ZeroFlow(), more=more)
        if self.frames < _LENGTH or (self.frames - _LENGTH) % (2 * _EVERY):
            expected = f"{_LENGTH} plus a multiple of {2 * _EVERY}, such as 41"
            raise ValueError(f"frames: expected {expected}, got {self.frames}")
        self.maps = maps
        self.per_channel, self.skip = per_channel, skip
        planes, enlarged = (1, 2 * self.scale) if per_channel else (3, self.scale)
        self.enlarged = enlarged
        self.kernels = nn.Sequential(
            *ConvBlock(_LENGTH, width), *ConvBlock(width, width), nn.Conv2d(width, maps * _LENGTH, 1)
        )
        self.represent = conv(maps * planes, width)
        self.guide = nn.Sequential(*ConvBlock(2 * width, width), *ConvBlock(width, width))
        self.align = DeformableConv2d(width)
        self.start = sub_pixel_convolutions(width, enlarged)
        self.corrections = nn.ModuleList(_Correction(width, enlarged) for _ in range(corrections))
        self.picture = conv(width, planes)
        if skip:
            begin_at_zero(self.picture)

    def forward(self, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:
        """Return rgb; the flow is ignored."""
        self.check_spikes(spikes)
        spikes = spikes.to(self.picture.weight.dtype)
        if self.per_channel:
            still = spikes.new_zeros(len(spikes), 2, 2, *spikes.shape[-2:])
            rgb = run_per_channel(lambda planes, _: self._reconstruct(planes), spikes, still, self.pattern, self.scale)
        else:
            rgb = self._reconstruct(spikes)
        return rgb.to(spikes.dtype)

    def _reconstruct(self, spikes: Tensor) -> Tensor:
        """Return pictures (B, 3, s H, s W), or (B, 1, 2 s H, 2 s W) of a sub-stream."""
        windows = spikes.unfold(1, _LENGTH, _EVERY).movedim(-1, 2)  # (B, M, length, H, W)
        count = windows.shape[1]
        features = self._represent(windows.flatten(0, 1)).unflatten(0, (-1, count))
        middle = features[:, count // 2]
        aligned = torch.stack(
            [self.align(found, self.guide(torch.cat([found, middle], dim=1))) for found in features.unbind(dim=1)]
        ).mean(dim=0)
        picture = self.start(middle)
        for correct in self.corrections:
            picture = picture + correct(picture, aligned)
        rgb = self.picture(picture)
        if self.skip:
            raw = decode_pictures(spikes, [self.frames // 2], self.alpha)[:, 0]
            rgb = rgb + enlarged_raw(raw, None if self.per_channel else self.pattern, self.enlarged)
        return rgb

    def _represent(self, window: Tensor) -> Tensor:
        """Filter the spikes with kernels predicted per pixel, (B, length, H, W) to (B, width, H, W)."""
        kernels = self.kernels(window).unflatten(1, (self.maps, _LENGTH)).softmax(dim=2)
        maps = torch.einsum("bkthw,bthw->bkhw", kernels, window.to(kernels.dtype)) / self.alpha
        if not self.per_channel:
            maps = split_colors(maps, self.pattern).movedim(0, 1).flatten(1, 2)
        return self.represent(maps)


class _Correction(nn.Module):
    """Correction of the picture's features, from their error at the sensor's resolution."""

    def __init__(self, width: int, scale: int) -> None:
        super().__init__()
        self.shrink = nn.Conv2d(width, width, scale + 4, scale, 2)
        self.body = res_blocks(width, 2)
        self.enlarge = nn.ConvTranspose2d(width, width, scale + 4, scale, 2)

    def forward(self, picture: Tensor, aligned: Tensor) -> Tensor:
        return self.enlarge(self.body(aligned - self.shrink(picture)))
