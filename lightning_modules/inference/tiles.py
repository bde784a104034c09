"""Tiled inference: large recordings in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from inspect import signature
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightning_modules.networks import Network

#: side of a tile, in sensor pixels, where nothing else is asked for
TILE = 200
#: on a GPU, which has more memory, and needs larger ones to be busy
TILE_ON_GPU = 512
#: motion that is followed over the edge of a tile, in sensor pixels; what moves further is searched inside
FAR = 48


@torch.no_grad()
def forward_in_tiles(
    network: Network,
    spikes: Tensor,
    tile: int,
    flow: Tensor | None = None,
    static: bool = False,
    done: Callable[[float], object] | None = None,
) -> Tensor:
    r"""Run a network on tiles that overlap, and put the results together.

    Motion, where none is given, is estimated once, on the whole clip. What a network sees around a tile, its ``halo``
    and as far as motion reaches, is computed and thrown away. A network whose ``halo`` is None is run on the whole
    picture, whatever the tile.

    Args:
        network: any of :mod:`lightning_modules.networks`.
        spikes: :math:`(B, N, H, W)`.
        tile: side of a tile in sensor pixels, even so that the Bayer phase is kept; 0 for no tiles.
        flow: as the network takes it; when not given, the network's own estimate.
        static: nothing moves, instead of a flow.
        done: called after every tile, with the share of them that is done.

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

    return tiled(run, whole, tile, lambda box: reach(flow, box, whole, network.halo), network.scale, done)


def call(network: Network, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:
    """Run a network; one of users' own may take spikes and a flow alone, or spikes alone."""
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
    done: Callable[[float], object] | None = None,
) -> Tensor:
    """Put planes together of what is computed of tiles.

    Args:
        run: makes planes (..., s h, s w) of a box of h x w sensor pixels.
        whole: box of all planes.
        tile: side of a tile in sensor pixels, 0 for a single one.
        around: how much around a box is to be seen.
        scale: pixels of the planes for a sensor pixel, s.
        done: called after every tile, with the share of them that is done.

    Returns:
        (..., s H, s W).
    """
    height, width = whole.bottom - whole.top, whole.right - whole.left
    if not tile or max(height, width) <= tile:
        return run(whole)
    planes = None
    corners = [(top, left) for top in range(0, height, tile) for left in range(0, width, tile)]
    for top, left in _told(corners, done):
        box = Box(top, left, top + tile, left + tile).grown(0, whole)
        outer = box.grown(around(box), whole)
        part = run(outer)
        if planes is None:
            planes = part.new_empty(*part.shape[:-2], scale * height, scale * width)
        box.of(planes, scale=scale).copy_(box.of(part, outer[:2], scale))
    return planes


def _told(tiles: Iterable[Any], done: Callable[[float], object] | None) -> Iterator[Any]:
    tiles = list(tiles)
    for count, tile in enumerate(tiles, 1):
        yield tile
        if done is not None:
            done(count / len(tiles))


class Box(NamedTuple):
    """A rectangle of sensor pixels."""

    top: int
    left: int
    bottom: int
    right: int

    def grown(self, margin: int, frame: Box) -> Box:
        """Return the box with a margin, cut off at the edges of a frame."""
        outer = self.top - margin, self.left - margin, self.bottom + margin, self.right + margin
        return Box(*map(max, outer[:2], frame[:2]), *map(min, outer[2:], frame[2:]))

    def of(self, planes: Tensor, corner: tuple[int, int] = (0, 0), scale: int = 1) -> Tensor:
        """Return this part of planes that begin at a corner and have ``scale`` pixels for one."""
        rows = slice(scale * (self.top - corner[0]), scale * (self.bottom - corner[0]))
        return planes[..., rows, scale * (self.left - corner[1]) : scale * (self.right - corner[1])]


def reach(flow: Tensor | None, box: Box, frame: Box, halo: int) -> int:
    """Return how much around a box of a frame a network has to see: even, as the Bayer phase is kept."""
    if flow is None:
        return halo
    near = box.grown(halo, frame).of(flow, frame[:2])
    return halo + 2 * math.ceil(near.nan_to_num().abs().amax().clamp(max=FAR).item() / 2)
