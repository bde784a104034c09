"""Spread of a sensor's gains, estimated from any scene."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.color.cfa import GREY

_SIDE = 8  # side of a block, in pixels of one colour
_QUANTILE = 0.05  # of the blocks: those with the least texture
_OF_NOISE = 0.555  # that quantile for a block of white noise of variance 1
_LEAST_SPIKES = 8  # of a pixel, on average over a block

#: the second difference in both directions, with which white noise keeps its variance
SECOND_DIFFERENCE = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6


def gain_spread(rate: Tensor, frames: int, parts: int = 1, pattern: str = GREY) -> float | None:
    r"""Estimate the relative standard deviation of the gains from the mean rates of the pixels.

    The noise is that of the flattest blocks, without the rounding of an ideal sensor, whose counts have a variance of
    1/6 on average. Texture may hide in it: motion, or parts far apart, makes the estimate better.

    Args:
        rate: spikes per clock, :math:`(H, W)`.
        frames: clocks per part that were counted.
        parts: number of parts, apart from each other, of which ``rate`` is the mean.
        pattern: Bayer phase, or ``"grey"``.

    Returns:
        the spread, 0 for an ideal sensor, or ``None`` if the picture is too small or too dark.

    Source:
        The filter is that of J. Immerkaer, "Fast noise variance estimation", CVIU 64(2), 1996.

    Example:
        >>> gains = 1 + 0.06 * torch.randn(64, 64, generator=torch.Generator().manual_seed(0))
        >>> round(gain_spread(0.3 * gains, frames=400), 2), gain_spread(torch.full((64, 64), 0.3), frames=400)
        (0.06, 0.0)
    """
    step = 1 if pattern == GREY else 2
    found = []
    for plane in (rate[row::step, column::step].float() for row in range(step) for column in range(step)):
        if min(plane.shape) < _SIDE + 2:
            return None
        noise = F.conv2d(plane[None, None], SECOND_DIFFERENCE.to(plane)[None, None]).square()
        noise = F.avg_pool2d(noise, _SIDE) - 1 / (6 * parts * frames**2)
        mean = F.avg_pool2d(plane[None, None, 1:-1, 1:-1], _SIDE)
        found.append((noise / mean.square())[mean * parts * frames >= _LEAST_SPIKES])
    blocks = torch.cat(found)
    if not len(blocks):
        return None
    return (torch.quantile(blocks, _QUANTILE) / _OF_NOISE).clamp(min=0).sqrt().item()
