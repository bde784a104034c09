"""A stand-in for SpikeSR-Net, whose code and text are not public."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightning_modules.motion import ZeroFlow
from lightning_modules.networks.baselines.deformable import DeformableConv2d
from lightning_modules.networks.baselines.per_channel import per_channel as run_per_channel
from lightning_modules.networks.baselines.pictures import (
    Baseline,
    begin_at_zero,
    decode_pictures,
    enlarged_raw,
    sub_pixel_convolutions,
    whole_sizes,
)
from lightning_modules.networks.layers import ConvBlock, conv, res_blocks
from spikekit import split_colors


class SpikeSRNetLike(Baseline):
    r"""SpikeSR-Net (Zhao et al., AAAI 2023), for grey spike cameras, as far as it is published.

    From the publication, of which no more than the abstract and figures in later papers could be had: a spike encoder
    that adapts to every pixel turns the stream into representations of several times; a resolver that is led by the
    observation model aligns them and exploits them again and again; at x4 the grey network has 3.34 million weights.

    Ours, and so everything that can be counted: windows of 13 spikes at every 7th; kernels over the spikes of a
    window, predicted for every pixel, 16 of them; alignment to the middle one by a deformable convolution whose offsets
    come from both; a picture's features that are corrected four times by the enlarged difference of the mean of the
    aligned representations and the shrunk features. The 16 filtered maps are split into the three colours, zeros
    elsewhere: a convolution over a bare mosaic could not know which colour is where. No flow is asked for. A ``width``
    of 32 with 12 ``maps`` does the work of CSCSR's size small, or 24 and 8 ``per_channel``.

    Offsets may reach anywhere, so it is not run tile by tile.

    Args:
        scale: super-resolution factor s.
        frames: spike frames N of a clip, odd.
        length: spike frames of a representation, odd.
        every: spike frames between two representations; must divide frames - length an even number of times, so that
            one of them is of the middle frame.
        pattern: Bayer phase.
        alpha: gain of the camera, what a white pixel receives per clock in thresholds; the spikes are divided by it.
        width: channels, a multiple of 8.
        maps: kernels of every pixel.
        corrections: of the picture's features.
        per_channel: the star of the paper's table: every sub-stream by itself, one network for all.
        skip: learn what to add to the bicubically enlarged TFI picture; with it training starts where a decoder ends.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, zeros and ones, any real dtype; a flow changes nothing
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Example:
        >>> SpikeSRNetLike(scale=2, width=8, maps=2, corrections=1)(torch.zeros(1, 41, 8, 6)).shape
        torch.Size([1, 3, 16, 12])
    """

    takes_flow = False

    def __init__(
        self,
        scale: int = 4,
        frames: int = 41,
        length: int = 13,
        every: int = 7,
        pattern: str = "RGGB",
        alpha: float = 0.4,
        width: int = 64,
        maps: int = 16,
        corrections: int = 4,
        per_channel: bool = False,
        skip: bool = False,
    ) -> None:
        sizes = whole_sizes(length=length, every=every, width=width, maps=maps, corrections=corrections)
        super().__init__(scale, frames, pattern, alpha, {**sizes, "per_channel": per_channel, "skip": skip}, ZeroFlow())
        if length % 2 == 0 or length > frames or (frames - length) % (2 * every):
            raise ValueError(
                "length, every: expected an odd length, and every so many frames that they divide frames - length an "
                f"even number of times, got {length} and {every} with {frames} frames"
            )
        self.length, self.every, self.maps = length, every, maps
        self.per_channel, self.skip = per_channel, skip
        planes, enlarged = (1, 2 * self.scale) if per_channel else (3, self.scale)
        self.enlarged = enlarged
        self.kernels = nn.Sequential(
            *ConvBlock(length, width), *ConvBlock(width, width), nn.Conv2d(width, maps * length, 1)
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
        """Return rgb; a flow changes nothing."""
        self.check_spikes(spikes)
        spikes = spikes.to(self.picture.weight.dtype)
        if self.per_channel:
            still = spikes.new_zeros(len(spikes), 2, 2, *spikes.shape[-2:])
            rgb = run_per_channel(lambda planes, _: self._reconstruct(planes), spikes, still, self.pattern, self.scale)
        else:
            rgb = self._reconstruct(spikes)
        return rgb.to(spikes.dtype)

    def _reconstruct(self, spikes: Tensor) -> Tensor:
        """Return pictures, (B, 1 or 3, s H, s W), s being twice the scale where every colour is by itself."""
        windows = spikes.unfold(1, self.length, self.every).movedim(-1, 2)  # (B, M, length, H, W)
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
        """Filter the spikes of every pixel by kernels of its own: (B, length, H, W) to (B, width, H, W)."""
        kernels = self.kernels(window).unflatten(1, (self.maps, self.length)).softmax(dim=2)
        maps = torch.einsum("bkthw,bthw->bkhw", kernels, window.to(kernels.dtype)) / self.alpha
        if not self.per_channel:
            maps = split_colors(maps, self.pattern).movedim(0, 1).flatten(1, 2)
        return self.represent(maps)


class _Correction(nn.Module):
    """The error of the features of a picture, seen at the sensor's resolution."""

    def __init__(self, width: int, scale: int) -> None:
        super().__init__()
        self.shrink = nn.Conv2d(width, width, scale + 4, scale, 2)
        self.body = res_blocks(width, 2)
        self.enlarge = nn.ConvTranspose2d(width, width, scale + 4, scale, 2)

    def forward(self, picture: Tensor, aligned: Tensor) -> Tensor:
        return self.enlarge(self.body(aligned - self.shrink(picture)))
