"""VidarSR, super-resolution of grey spike streams, applied to Bayer-pattern streams."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from lightning_modules.networks.baselines.parts import (
    Baseline,
    begin_at_zero,
    decode_pictures,
    enlarged_raw,
    run_per_channel,
    whole_sizes,
)
from lightning_modules.networks.layers import conv
from lightning_modules.signatures import inherit_signature
from spikekit import split_colors

_Move = Callable[[int, int, int], nn.Module]


class VidarSR(Baseline):
    r"""VidarSR (Xiang et al., TCSVT 2023), a network of the RBPN family for grey spike cameras, after its public code.

    As published: a pixel-wise encoder of the spikes; for each neighbour in time, features of the pair of its picture
    and the middle one; recurrent back-projection with weights shared by the neighbours; a last convolution over the
    results of all neighbours. It uses convolutions and PReLU, without normalisation.

    Differences: spikes are those of the Bayer mosaic, and a picture is split into three colour planes with zeros at
    other pixels, so that convolutions can tell the colours apart. Pictures and spikes are divided by alpha instead of
    their maximum. Of 41 frames the middle one is 20 and the neighbours are 6, 13, 27 and 34. Linear motion replaces
    the flow of pyflow. The default size takes a fifth of the work of the published one, which has a ``width`` of 256
    and 64 ``features``; 16 and 8 take as much work as CSCSR's size small, and so do 10 and 4 ``per_channel``.

    At x2 the receptive field reaches 102 sensor pixels in each direction, which is too large for tiles.

    Args:
        scale, frames, pattern, alpha, motion: see :class:`Baseline`.
        width: channels at the sensor's resolution.
        features: channels at the picture's resolution.
        per_channel: reconstruct each Bayer sub-stream separately, as the paper's VidarSR with a star.
        skip: predict a residual, which is added to the demosaiced and bicubically enlarged TFI picture, so that
            training starts from the result of the decoder. The publication has no such skip.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, zeros and ones of any real dtype; optionally the flows from the middle to
          the first and last time points, :math:`(B, 2, 2, H, W)`, in sensor pixels; or ``static=True``
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Example:
        >>> network = VidarSR(scale=2, width=8, features=4)
        >>> network(torch.zeros(1, 41, 8, 6), torch.zeros(1, 2, 2, 8, 6)).shape
        torch.Size([1, 3, 16, 12])
    """

    @inherit_signature(Baseline, "more")
    def __init__(
        self,
        *args: Any,
        width: int = 64,
        features: int = 32,
        per_channel: bool = False,
        skip: bool = False,
        **common: Any,
    ) -> None:
        more = {**whole_sizes(width=width, features=features), "per_channel": per_channel, "skip": skip}
        super().__init__(*args, **common, more=more)
        frames = self.frames
        self.per_channel, self.skip = per_channel, skip
        #: the middle frame and its neighbours in time
        self.times = frames // 2, frames // 6, frames // 3, frames - 1 - frames // 3, frames - 1 - frames // 6
        planes, enlarged = (1, 2 * self.scale) if per_channel else (3, self.scale)
        self.enlarged = enlarged
        self.encode_spikes = nn.Sequential(nn.Conv2d(frames, 128, 1), nn.PReLU(), nn.Conv2d(128, width, 1), nn.PReLU())
        self.encode_pair = nn.Sequential(conv(2 * planes + 2, width), nn.PReLU())
        self.enlarge = _BackProjection(width, features, enlarged)
        self.enlarge_pair = nn.Sequential(_res_blocks(width), _up(width, features, enlarged))
        self.refine = nn.Sequential(_res_blocks(features), conv(features, features), nn.PReLU())
        self.shrink = nn.Sequential(_res_blocks(features), _down(features, width, enlarged))
        self.picture = conv((len(self.times) - 1) * features, planes)
        if skip:
            begin_at_zero(self.picture)

    def forward(self, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:  # noqa: D102
        self.check_spikes(spikes)
        spikes = spikes.to(self.picture.weight.dtype)
        flow = self.flow_or_estimate(spikes, flow, static).to(spikes.dtype)
        if self.per_channel:
            rgb = run_per_channel(self._reconstruct, spikes, flow, self.pattern, self.scale)
        else:
            rgb = self._reconstruct(spikes, flow)
        return rgb.to(spikes.dtype)

    def _reconstruct(self, spikes: Tensor, flow: Tensor) -> Tensor:
        """Return pictures (B, 3, s H, s W), or (B, 1, 2 s H, 2 s W) of a sub-stream."""
        offsets = self.offsets(flow, self.times[1:])
        raws = decode_pictures(spikes, self.times, self.alpha)
        planes = raws.unsqueeze(2) if self.per_channel else split_colors(raws, self.pattern).movedim(0, 2)
        center, *neighbors = planes.unbind(dim=1)
        features, found = self.encode_spikes(spikes / self.alpha), []
        for n, neighbor in enumerate(neighbors):
            pair = self.encode_pair(torch.cat([center, neighbor, offsets[:, n]], dim=1))
            enlarged = self.enlarge(features)
            enlarged = enlarged + self.refine(enlarged - self.enlarge_pair(pair))
            found.append(enlarged)
            if n + 1 < len(neighbors):
                features = self.shrink(enlarged)
        rgb = self.picture(torch.cat(found, dim=1))
        if self.skip:
            rgb = rgb + enlarged_raw(raws[:, 0], None if self.per_channel else self.pattern, self.enlarged)
        return rgb


class _ResBlock(nn.Module):
    """Residual block: convolution, PReLU, convolution, plus the input, PReLU."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = conv(width, width)
        self.second = conv(width, width)
        self.act = nn.PReLU()  # shared, as in the original

    def forward(self, x: Tensor) -> Tensor:
        return self.act(x + self.second(self.act(self.first(x))))


def _res_blocks(width: int) -> nn.Sequential:
    return nn.Sequential(*(_ResBlock(width) for _ in range(5)))


def _up(inputs: int, outputs: int, scale: int) -> nn.Sequential:
    return nn.Sequential(nn.ConvTranspose2d(inputs, outputs, scale + 4, scale, 2), nn.PReLU())


def _down(inputs: int, outputs: int, scale: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, scale + 4, scale, 2), nn.PReLU())


class _Unit(nn.Module):
    """Projection unit: resize, resize back, and resize the error of the way back (Haris et al., CVPR 2018)."""

    def __init__(self, width: int, scale: int, there: _Move, back: _Move) -> None:
        super().__init__()
        self.there, self.back, self.again = (move(width, width, scale) for move in (there, back, there))

    def forward(self, x: Tensor) -> Tensor:
        there = self.there(x)
        return there + self.again(self.back(there) - x)


class _BackProjection(nn.Module):
    """DBPN with three up-projections and two down-projections, (B, inputs, H, W) to (B, width, s H, s W)."""

    def __init__(self, inputs: int, width: int, scale: int) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Conv2d(inputs, width, 1), nn.PReLU())
        self.ups = nn.ModuleList(_Unit(width, scale, _up, _down) for _ in range(3))
        self.downs = nn.ModuleList(_Unit(width, scale, _down, _up) for _ in range(2))
        self.last = nn.Conv2d(3 * width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        enlarged = [self.ups[0](self.first(x))]
        for up, down in zip(self.ups[1:], self.downs, strict=True):
            enlarged.append(up(down(enlarged[-1])))
        return self.last(torch.cat(enlarged, dim=1))
