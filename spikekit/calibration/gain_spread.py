"""Spread of a sensor's gains, estimated from any scene."""

from __future__ import annotations

from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.color.cfa import GREY

_AROUND = 5  # side of a neighbourhood, in pixels of one colour
_SIDE = 8  # side of a block, in pixels
_QUANTILE = 0.05  # of the blocks: those with the least texture
_OF_NOISE = 0.55  # that quantile for blocks of white noise of variance 1
_TEXTURE = 2.0  # ratio of the quartile to that quantile above which blocks differ by texture; 1.4 for white noise
_SURE, _MOST = 0.06, 0.15  # spread up to which texture matters little, and above which it is no noise
_LEAST_SPIKES = 8  # of a pixel, on average over a block
_MANY_SPIKES = 32  # with fewer, gains are not the only noise that matters

#: the second difference in both directions, with which white noise keeps its variance
SECOND_DIFFERENCE = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6


def gain_spread(rates: Tensor, frames: int, pattern: str = GREY) -> float | None:
    r"""Estimate the relative standard deviation of the gains from the mean rates of the pixels.

    The smaller of two estimates, both from rates relative to the mean of their colour nearby: the noise of the
    flattest blocks, without the rounding of an ideal sensor, whose counts have a variance of 1/6 on average; and, if
    there are several parts, the noise that they have in common in the median block, unless most blocks have few spikes.
    Texture is not taken for noise by the first if some of the picture is flat, by the second if it moves. Otherwise, a
    spread above 0.06 in blocks that differ, or above 0.15, more than sensors have, tells nothing.

    Args:
        rates: spikes per clock in parts of a recording, apart from each other, :math:`(P, H, W)`.
        frames: clocks per part that were counted.
        pattern: Bayer phase, or ``"grey"``.

    Returns:
        the spread, 0 for an ideal sensor, or ``None`` if the picture is too small, too dark, or textured everywhere.

    Source:
        The filter is that of J. Immerkaer, "Fast noise variance estimation", CVIU 64(2), 1996.

    Example:
        >>> gains = 1 + 0.06 * torch.randn(1, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> round(gain_spread(0.3 * gains, frames=400), 2), gain_spread(torch.full((1, 64, 64), 0.3), frames=400)
        (0.06, 0.0)
    """
    if min(rates.shape[1:]) < _SIDE + 2:
        return None
    step, parts = 1 if pattern == GREY else 2, len(rates)
    rates = rates.float()
    near = torch.empty_like(rates[:1])
    for row, column in product(range(step), repeat=2):
        plane = rates[:, row::step, column::step].mean(0, keepdim=True)
        near[:, row::step, column::step] = F.avg_pool2d(plane, _AROUND, 1, _AROUND // 2, count_include_pad=False)
    noise = F.conv2d((rates / near.clamp(min=1e-9))[:, None], SECOND_DIFFERENCE.to(rates)[None, None])
    rounding = 1 / (6 * (near * parts * frames).square())
    blocks = noise.sum(0).square() / parts**2, noise.square().sum(0) / parts**2, rounding[:, 1:-1, 1:-1]
    of_sum, of_parts, rounding = (F.avg_pool2d(part, _SIDE) for part in blocks)
    known, bright = (rounding <= 1 / (6 * least**2) for least in (_LEAST_SPIKES, _MANY_SPIKES))
    if not known.any():
        return None
    flattest, quartile = torch.quantile((of_sum - parts * rounding)[known], torch.tensor([_QUANTILE, 0.25])).tolist()
    found, textured = flattest / _OF_NOISE, quartile > _TEXTURE * flattest
    if parts > 1 and bright.sum() > known.sum() / 2:
        in_all = ((of_sum - of_parts) * parts / (parts - 1))[bright].median().item()
        found, textured = min((found, textured), (in_all, False))
    spread = max(found, 0) ** 0.5
    return None if spread > _MOST or (textured and spread > _SURE) else spread
