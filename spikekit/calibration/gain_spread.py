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
_MANY_SPIKES = 32  # with fewer, gains are not the only noise that matters

#: the second difference in both directions, with which white noise keeps its variance
SECOND_DIFFERENCE = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6


def gain_spread(rates: Tensor, frames: int, pattern: str = GREY) -> float | None:
    r"""Estimate the relative standard deviation of the gains from the mean rates of the pixels.

    The smaller of two estimates: the noise of the flattest blocks, without the rounding of an ideal sensor, whose
    counts have a variance of 1/6 on average; and, if there are several parts, the noise that they have in common in the
    median block, unless most blocks have few spikes. Texture is not taken for noise by the first if some of the picture
    is flat, by the second if it moves.

    Args:
        rates: spikes per clock in parts of a recording, apart from each other, :math:`(P, H, W)`.
        frames: clocks per part that were counted.
        pattern: Bayer phase, or ``"grey"``.

    Returns:
        the spread, 0 for an ideal sensor, or ``None`` if the picture is too small or too dark.

    Source:
        The filter is that of J. Immerkaer, "Fast noise variance estimation", CVIU 64(2), 1996.

    Example:
        >>> gains = 1 + 0.06 * torch.randn(1, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> round(gain_spread(0.3 * gains, frames=400), 2), gain_spread(torch.full((1, 64, 64), 0.3), frames=400)
        (0.06, 0.0)
    """
    step, parts = 1 if pattern == GREY else 2, len(rates)
    flattest, common = [], []
    for planes in (rates[:, row::step, column::step].float() for row in range(step) for column in range(step)):
        if min(planes.shape[1:]) < _SIDE + 2:
            return None
        noise = F.conv2d(planes[:, None], SECOND_DIFFERENCE.to(planes)[None, None])
        square, squares = (F.avg_pool2d(part, _SIDE) for part in (noise.sum(0).square(), noise.square().sum(0)))
        mean = F.avg_pool2d(planes.mean(0)[None, 1:-1, 1:-1], _SIDE)
        spikes, power = mean * parts * frames, mean.square()
        flattest.append(((square / parts**2 - 1 / (6 * parts * frames**2)) / power)[spikes >= _LEAST_SPIKES])
        if parts > 1:
            common.append(((square - squares) / (parts * (parts - 1)) / power)[spikes >= _MANY_SPIKES])
    blocks = torch.cat(flattest)
    if not len(blocks):
        return None
    found = torch.quantile(blocks, _QUANTILE) / _OF_NOISE
    in_all = torch.cat(common or [blocks[:0]])
    bright = len(in_all) > len(blocks) / 2
    return torch.minimum(found, in_all.median() if bright else found).clamp(min=0).sqrt().item()
