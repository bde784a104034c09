"""BasicVSR on demosaiced pictures at several times."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from lightning_modules.networks.baselines.parts import (
    Baseline,
    decode_pictures,
    sub_pixel_convolutions,
    whole_sizes,
)
from lightning_modules.networks.layers import conv, enlarge, res_blocks
from lightning_modules.signatures import inherit_signature
from spikekit import demosaic_along_motion, flow_warp

_TIMES = 11
_NEIGHBORS = 2  # pictures on either side in time that demosaicing uses


class BasicVSR(Baseline):
    r"""BasicVSR (Chan et al., CVPR 2021) on 3DRI-like pictures, the paper's 3DRI+BasicVSR.

    As published: features propagate forwards and backwards in time, warped by flow, through a convolution and residual
    blocks. Both directions are merged, enlarged by sub-pixel convolutions, and added to the bilinear picture. Only the
    middle picture is computed, so each direction ends there.

    Differences: the 11 pictures, at frames 5, 8, ..., 35 of 41, are TFI mosaics with 3DRI-like demosaicing, each with
    two neighbours in time on either side. Instead of SPyNet, whose weights are not available (1,440,300 parameters),
    the flow between two times is the difference of their linear motions from CSCSR's motion estimators. The published
    size has 30 blocks per direction, the default 10. A ``width`` of 24 takes as much work as CSCSR's size small.

    More than 70 convolutions follow each other, so the receptive field is too large for tiles.

    Args:
        scale, frames, pattern, alpha, motion: see :class:`Baseline`; clips have at least 13 frames.
        width: channels.
        blocks: residual blocks per direction.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, zeros and ones of any real dtype; optionally the flows from the middle to
          the first and last time points, :math:`(B, 2, 2, H, W)`, in sensor pixels; or ``static=True``
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Example:
        >>> network = BasicVSR(scale=2, width=8, blocks=1)
        >>> network(torch.zeros(1, 41, 8, 6), torch.zeros(1, 2, 2, 8, 6)).shape
        torch.Size([1, 3, 16, 12])
    """

    @inherit_signature(Baseline, "more")
    def __init__(self, *args: Any, width: int = 64, blocks: int = 10, **common: Any) -> None:
        super().__init__(*args, **common, more=whole_sizes(width=width, blocks=blocks))
        middle = self.frames // 2
        step = (middle - self.frames // 8) // (_TIMES // 2)
        if step < 1:
            raise ValueError(f"frames: expected at least 13, got {self.frames}")
        self.times = tuple(middle + step * n for n in range(-(_TIMES // 2), _TIMES // 2 + 1))
        act = nn.LeakyReLU(0.1)
        self.backward_trunk, self.forward_trunk = (
            nn.Sequential(conv(3 + width, width), nn.LeakyReLU(0.1), *res_blocks(width, blocks)) for _ in range(2)
        )
        self.merge = nn.Sequential(nn.Conv2d(2 * width, width, 1), act)
        self.enlarge = sub_pixel_convolutions(width, self.scale, act)
        self.picture = nn.Sequential(conv(width, width), act, conv(width, 3))

    def forward(self, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:  # noqa: D102
        self.check_spikes(spikes)
        spikes = spikes.to(self.picture[0].weight.dtype)
        flow = self.flow_or_estimate(spikes, flow, static).to(spikes.dtype)
        offsets = self.offsets(flow, self.times)
        pictures = self._demosaic(spikes, offsets)
        half = _TIMES // 2
        backward = self._propagate(self.backward_trunk, pictures, offsets, range(_TIMES - 1, half - 1, -1))
        onward = self._propagate(self.forward_trunk, pictures, offsets, range(half + 1))
        features = self.enlarge(self.merge(torch.cat([backward, onward], dim=1)))
        return (self.picture(features) + enlarge(pictures[:, half], self.scale)).to(spikes.dtype)

    @torch.no_grad()
    def _demosaic(self, spikes: Tensor, offsets: Tensor) -> Tensor:
        """Return the demosaiced pictures at all times, (B, T, 3, H, W)."""
        raws = decode_pictures(spikes, self.times, self.alpha)
        pictures = []
        for n in range(_TIMES):
            # mirrored in time, to keep the picture in the middle
            around = [_TIMES - 1 - abs(_TIMES - 1 - abs(n + k)) for k in range(-_NEIGHBORS, _NEIGHBORS + 1)]
            motion = offsets[:, around] - offsets[:, n : n + 1]
            pictures.append(demosaic_along_motion(raws[:, around], motion, self.pattern))
        return torch.stack(pictures, dim=1)

    def _propagate(self, trunk: nn.Module, pictures: Tensor, offsets: Tensor, times: Iterable[int]) -> Tensor:
        """Propagate features through time, and return those of the last time."""
        state, before = None, None
        for time in times:
            if state is None:
                state = pictures.new_zeros(len(pictures), self.settings["width"], *pictures.shape[-2:])
            else:
                state = flow_warp(state, offsets[:, before] - offsets[:, time])
            state, before = trunk(torch.cat([pictures[:, time], state], dim=1)), time
        return state
