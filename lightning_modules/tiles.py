"""Large recordings in bounded memory: a network run tile by tile."""

from __future__ import annotations

import torch
from torch import Tensor

from lightning_modules.networks import Network

#: sensor pixels around a tile that are computed and thrown away; beyond what CSCSR sees of its neighbourhood
HALO = 24


@torch.no_grad()
def forward_in_tiles(network: Network, spikes: Tensor, tile: int) -> Tensor:
    r"""Run a network on tiles that overlap, and put the results together.

    Motion is estimated once, on the whole clip.

    Args:
        network: any of :mod:`lightning_modules.networks`.
        spikes: :math:`(B, N, H, W)`.
        tile: side of a tile in sensor pixels, even so that the Bayer phase is kept; 0 for no tiles.

    Returns:
        rgb :math:`(B, 3, s H, s W)`.
    """
    height, width = spikes.shape[-2:]
    if not tile or max(height, width) <= tile:
        return network(spikes)
    flow, s = network.estimate_flow(spikes), network.scale
    rgb = None
    for top in range(0, height, tile):
        for left in range(0, width, tile):
            y, x = max(top - HALO, 0), max(left - HALO, 0)
            rows, columns = slice(y, top + tile + HALO), slice(x, left + tile + HALO)
            part = network(spikes[..., rows, columns], flow[..., rows, columns])
            part = part[..., s * (top - y) :, s * (left - x) :][..., : s * tile, : s * tile]
            if rgb is None:
                rgb = part.new_empty(*part.shape[:-2], s * height, s * width)
            rgb[..., s * top : s * (top + tile), s * left : s * (left + tile)] = part
    return rgb
