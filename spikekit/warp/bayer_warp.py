"""The warp of the pixels of one colour of a Bayer filter in plain tensor operations, as exported networks need it."""

from __future__ import annotations

import torch
from kornia.color import CFA
from torch import Tensor

from spikekit.color.cfa import cfa_sites
from spikekit.warp.neighbors import finite

_FLAT = 1 << 31  # above every flat index: a distance and an index make one number


def bayer_warp_idw(
    features: Tensor, flow: Tensor, pattern: str | CFA, color: int, scale: int, steps: int, neighbors: int = 4
) -> Tensor:
    """Do what :func:`spikekit.flow_warp_idw` does with the mask of one colour.

    No operator of our own, no table that depends on the size: what ``torch.export`` makes of it takes any even height
    and width of the sensor, of 8 pixels or more. It takes several times the time.

    Features are (B, C, s H, s W), flow (B, 2, s H, s W); colours 0, 1, 2 are R, G, B, and 0 is grey. Flow is rounded to
    one of ``steps`` positions per pixel and axis, an even number; at most 4 neighbours are weighed.
    """
    height, width = features.shape[-2:]
    x, y = (
        _rounded(flow[:, axis], torch.arange(length, device=flow.device).reshape(shape), length, steps)
        for axis, length, shape in ((0, width, (1, -1)), (1, height, (-1, 1)))
    )
    keys = []
    sites, side = cfa_sites(pattern)
    for colour, row, column in sites:
        if colour != color:
            continue
        rows = _nearest_on_axis(y, height, row, side, scale, steps, neighbors)
        columns = _nearest_on_axis(x, width, column, side, scale, steps, neighbors)
        for i in range(neighbors):
            for j in range(neighbors // (i + 1)):  # so many pixels of these rows and columns are at least as near
                square = (steps * rows[i] - y).square() + (steps * columns[j] - x).square()
                keys.append(square * _FLAT + rows[i] * width + columns[j])
    nearest = torch.stack(keys, dim=-1).topk(neighbors, largest=False, sorted=True).values
    distance = (nearest // _FLAT).to(flow.dtype).sqrt()
    # relative to the nearest: nothing for the others on a known pixel
    others = distance[..., :1] / distance[..., 1:]
    weight = torch.cat([torch.ones_like(distance[..., :1]), others], dim=-1)
    weight = (weight / weight.sum(dim=-1, keepdim=True)).to(features.dtype)
    index = (nearest % _FLAT).flatten(1, 2).unsqueeze(1)
    planes, weight = features.flatten(2), weight.flatten(1, 2).unsqueeze(1)
    result = torch.zeros_like(planes)
    for k in range(neighbors):
        result = result + weight[..., k] * planes.gather(2, index[..., k].expand_as(planes))
    return result.reshape(features.shape)


def _rounded(flow: Tensor, pixel: Tensor, length: int, steps: int) -> Tensor:
    """Where flow (B, s H, s W) points to on an axis, in steps: rounded, and at most half a pixel beyond the picture."""
    moved = pixel * steps + (finite(flow).double() * steps).round().long()
    return moved.clamp(min=-(steps // 2)).minimum(torch.full_like(pixel, length - 1) * steps + steps // 2)


def _nearest_on_axis(
    position: Tensor, length: int, site: int, side: int, scale: int, steps: int, neighbors: int
) -> list[Tensor]:
    """The known pixels nearest to each position on an axis, nearest first, the lower one among equals."""
    reach = 2 * scale + 8  # as far as the fourth can be, at a border as well
    half = torch.arange(2 * length, device=position.device)  # order does not change between half pixels
    candidates = (half // 2).unsqueeze(1) + torch.arange(-reach, reach + 1, device=position.device)
    known = (candidates >= 0) & (candidates < length) & (candidates.clamp(min=0) // scale % side == site)
    away = 2 * candidates - half.unsqueeze(1)
    order = torch.where(known, 2 * away.abs() + (away > 0), 1 << 20)
    found = order.float().topk(neighbors, largest=False, sorted=True).indices
    nearest = candidates.gather(1, found)
    place = -((-2 * position) // steps)
    place = place.clamp(min=0).minimum(half[-1])
    return [nearest[:, k][place] for k in range(neighbors)]
