"""Warping of one colour of a Bayer mosaic in plain tensor operations, for exported networks."""

from __future__ import annotations

import torch
from torch import Tensor

from spikekit.color.cfa import Pattern, cfa_sites
from spikekit.warp.neighbors import finite

_FLAT = 1 << 31  # exceeds every flat index; combines a distance and an index in one integer


def bayer_warp_idw(
    features: Tensor, flow: Tensor, pattern: Pattern, color: int, scale: int, steps: int, neighbors: int = 4
) -> Tensor:
    """Compute :func:`spikekit.flow_warp_idw` for the mask of one colour.

    It uses neither custom operators nor tables that depend on the size, so ``torch.export`` accepts any even height and
    width of the sensor from 8 pixels on. It takes several times as long.

    Features are (B, C, s H, s W), flow is (B, 2, s H, s W); colours 0, 1, 2 are R, G, B, and 0 is grey. Flow is rounded
    to ``steps`` positions per pixel and axis, an even number. At most 4 neighbours are supported.
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
            for j in range(neighbors // (i + 1)):  # (i + 1)(j + 1) pixels are at least as near
                square = (steps * rows[i] - y).square() + (steps * columns[j] - x).square()
                keys.append(square * _FLAT + rows[i] * width + columns[j])
    nearest = torch.stack(keys, dim=-1).topk(neighbors, largest=False, sorted=True).values
    distance = (nearest // _FLAT).to(flow.dtype).sqrt()
    # relative to the nearest: on a known pixel the other weights are 0
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
    """Return the positions of flow (B, s H, s W) on an axis, in steps, clamped to half a pixel outside the picture."""
    moved = pixel * steps + (finite(flow).double() * steps).round().long()
    return moved.clamp(min=-(steps // 2)).minimum(torch.full_like(pixel, length - 1) * steps + steps // 2)


def _nearest_on_axis(
    position: Tensor, length: int, site: int, side: int, scale: int, steps: int, neighbors: int
) -> list[Tensor]:
    """Return the known pixels nearest to each position on an axis, nearest first, the lower of equally near ones."""
    reach = 2 * scale + 8  # largest distance of the fourth, also at a border
    half = torch.arange(2 * length, device=position.device)  # the order is constant between half pixels
    candidates = (half // 2).unsqueeze(1) + torch.arange(-reach, reach + 1, device=position.device)
    known = (candidates >= 0) & (candidates < length) & (candidates.clamp(min=0) // scale % side == site)
    away = 2 * candidates - half.unsqueeze(1)
    order = torch.where(known, 2 * away.abs() + (away > 0), 1 << 20)
    found = order.float().topk(neighbors, largest=False, sorted=True).indices
    nearest = candidates.gather(1, found)
    place = -((-2 * position) // steps)
    place = place.clamp(min=0).minimum(half[-1])
    return [nearest[:, k][place] for k in range(neighbors)]
