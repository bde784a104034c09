"""Tiled inference, for large recordings in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from inspect import signature
from typing import NamedTuple

import torch
from torch import Tensor

from lightning_modules.networks import Network

#: default largest side of a tile, in sensor pixels
TILE = 256
#: default on a GPU, which has more memory and needs larger tiles to be busy
TILE_ON_GPU = 512
#: largest motion followed beyond the edge of a tile, in sensor pixels; larger motion is searched within the tile
FAR = 48


@torch.no_grad()
def forward_in_tiles(
    network: Network,
    spikes: Tensor,
    tile: int,
    flow: Tensor | None = None,
    static: bool = False,
) -> Tensor:
    r"""Run a network on overlapping tiles and join the results.

    By default, motion is estimated once on the whole clip. Tiles overlap by the ``halo`` of the network plus the reach
    of motion; the overlap is computed and discarded. A network whose ``halo`` is None runs on the whole picture.

    Args:
        network: network of :mod:`lightning_modules.networks`.
        spikes: :math:`(B, N, H, W)`.
        tile: largest side of a tile in sensor pixels; 0 for no tiles.
        flow: flow in the network's shape; default: the network's own estimate.
        static: nothing moves; replaces a flow.

    Returns:
        rgb :math:`(B, 3, s H, s W)`.
    """
    if network.halo is None:
        return call(network, spikes, flow, static)
    whole = Box(0, 0, *spikes.shape[-2:])
    flow = network.resolve_flow(spikes, flow, static)

    def run(outer: Box) -> Tensor:
        part = None if flow is None else outer.of(flow)
        return call(network, outer.of(spikes), part, part is None)

    return tiled(run, whole, tile, lambda box: reach(flow, box, whole, network.halo), network.scale)


def call(network: Network, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:
    """Run a network; networks of users may take spikes and a flow, or spikes only."""
    takes = signature(network.forward).parameters
    if "static" in takes:
        return network(spikes, flow, static)
    if "flow" not in takes:
        return network(spikes)
    resolved = network.resolve_flow(spikes, flow, static)
    if resolved is None:
        resolved = spikes.new_zeros(len(spikes), 2, 2, *spikes.shape[-2:], dtype=torch.float32)
    return network(spikes, resolved)


def tiled(
    run: Callable[[Box], Tensor],
    whole: Box,
    tile: int,
    around: Callable[[Box], int],
    scale: int = 1,
) -> Tensor:
    """Compute planes (..., s H, s W) in tiles of about the same size, even to keep the Bayer phase; 0 for one tile.

    ``run`` returns the planes of a box, and ``around`` the margin needed around it, in sensor pixels.
    """
    height, width = whole.bottom - whole.top, whole.right - whole.left
    if not tile or max(height, width) <= tile:
        return run(whole)
    planes = None
    rows, columns = (2 * -(-length // -(-length // tile) // 2) for length in (height, width))
    corners = [(top, left) for top in range(0, height, rows) for left in range(0, width, columns)]
    for top, left in corners:
        box = Box(top, left, top + rows, left + columns).grown(0, whole)
        outer = box.grown(around(box), whole)
        part = run(outer)
        if planes is None:
            planes = part.new_empty(*part.shape[:-2], scale * height, scale * width)
        box.of(planes, scale=scale).copy_(box.of(part, outer[:2], scale))
    return planes


class Box(NamedTuple):
    """A rectangle of sensor pixels."""

    top: int
    left: int
    bottom: int
    right: int

    def grown(self, margin: int, frame: Box) -> Box:
        """Return the box enlarged by a margin and clipped to a frame."""
        outer = self.top - margin, self.left - margin, self.bottom + margin, self.right + margin
        return Box(*map(max, outer[:2], frame[:2]), *map(min, outer[2:], frame[2:]))

    def of(self, planes: Tensor, corner: tuple[int, int] = (0, 0), scale: int = 1) -> Tensor:
        """Return this part of planes that begin at ``corner`` and have ``scale`` pixels per sensor pixel."""
        rows = slice(scale * (self.top - corner[0]), scale * (self.bottom - corner[0]))
        return planes[..., rows, scale * (self.left - corner[1]) : scale * (self.right - corner[1])]


def reach(flow: Tensor | None, box: Box, frame: Box, halo: int) -> int:
    """Return the margin that a network needs around a box of a frame; even, to keep the Bayer phase."""
    if flow is None:
        return halo
    near = box.grown(halo, frame).of(flow, frame[:2])
    return halo + 2 * math.ceil(near.nan_to_num().abs().amax().clamp(max=FAR).item() / 2)
