"""Static scenes: temporal pixel search and the convolution behind it, as one convolution of the sensor's pixels."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.networks.layers import enlarge, fold
from spikekit import bayer_mask, flow_warp_idw

#: sensor pixels along the shorter side of a picture from which on there is less work in it
WORTH_IT = 64
_AROUND = 2  # sensor pixels around a Bayer cell that its temporal pixels, and those next to it, are made of
_WINDOW = 2 + 2 * _AROUND


@lru_cache(maxsize=8)
def rest_response(scale: int, pattern: str, neighbors: int) -> Tensor | None:
    """Weights that the temporal pixels of a Bayer cell, and of the sites next to it, have where nothing moves.

    Args:
        scale: super-resolution factor s.
        pattern: Bayer phase.
        neighbors: known pixels that the search weighs.

    Returns:
        Weights (3, 36, s^2, 4, 4), float64. Its axes are the colours; the 6 x 6 sensor pixels in and around
        the cell; temporal pixels of a site; the 4 x 4 sites. None where they are made of pixels further away.
    """
    side, begin = 2 * _WINDOW, _WINDOW - 2  # of a picture large enough, and of a cell in its middle
    near, sites = slice(begin - _AROUND, begin + 2 + _AROUND), slice(begin - 1, begin + 3)
    pixels = torch.eye(side**2, dtype=torch.float64, device="cpu").reshape(1, -1, side, side)
    pixels = enlarge(pixels, scale)
    flow = pixels.new_zeros(1, 2, *pixels.shape[-2:])
    colors = []
    for mask in bayer_mask(side, side, pattern, scale=scale, device="cpu"):
        found = fold(flow_warp_idw(pixels, flow, mask, neighbors=neighbors).movedim(0, 1), scale)
        found = found[..., sites, sites].unflatten(0, (side, side))[near, near].flatten(0, 1)
        if not torch.allclose(found.sum(dim=0), torch.ones_like(found[0])):
            return None
        colors.append(found)
    return torch.stack(colors)


def convolve_at_rest(
    features: Tensor, weight: Tensor, bias: Tensor, response: Tensor, search: Callable[[Tensor], Tensor]
) -> Tensor:
    """Search without motion, fold, convolve 3 x 3: all of it is linear, and the same in every Bayer cell.

    Not so in the outermost cells, where the search finds other pixels and the convolution zeros: there it is done step
    by step, for opposite sides together.

    Args:
        features: of one colour, at sensor resolution, (B, I, H, W), H and W at least 12.
        weight: (O, I s^2, 3, 3).
        bias: (O,).
        response: of this colour, see :func:`rest_response`, (36, s^2, 4, 4).
        search: what searches without motion and folds, (B, I, H, W) to (B, I s^2, H, W).

    Returns:
        (B, O, H, W).
    """
    height, width = features.shape[-2:]
    with torch.autocast(features.device.type, enabled=False):
        sites = response.unfold(-2, 3, 1).unfold(-2, 3, 1)  # (36, s^2, 2, 2, 3, 3)
        parts = weight.unflatten(1, (features.shape[1], -1)).to(response)
        kernel = torch.einsum("psabyx,oisyx->oabip", sites, parts).unflatten(-1, (_WINDOW, _WINDOW)).flatten(0, 2)
    cells = features[..., : height // 2 * 2, : width // 2 * 2]
    inner = F.pixel_shuffle(F.conv2d(cells, kernel.to(features), bias.repeat_interleave(4), stride=2), 2)

    def sides(dim: int) -> tuple[Tensor, Tensor]:
        length = features.shape[dim]
        begin = (length - _WINDOW) // 2 * 2  # the Bayer phase is kept
        both = torch.cat([features.narrow(dim, 0, _WINDOW), features.narrow(dim, begin, length - begin)], dim)
        found = search(both)
        last = _AROUND + length % 2
        ends = found.narrow(dim, 0, _AROUND + 1), found.narrow(dim, found.shape[dim] - last - 1, last + 1)
        seen = F.conv2d(torch.cat(ends, dim), weight, bias, padding=1)
        return seen.narrow(dim, 0, _AROUND), seen.narrow(dim, seen.shape[dim] - last, last)

    (top, bottom), (left, right) = sides(-2), sides(-1)
    rows = slice(_AROUND, height - bottom.shape[-2])
    return torch.cat([top, torch.cat([left[..., rows, :], inner, right[..., rows, :]], -1), bottom], -2)
