"""Tiled inference: large recordings in bounded memory, and less work where the scene needs less."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightning_modules.inference.scene_activity import CELL, look, required
from lightning_modules.networks import Network

#: side of a tile, in sensor pixels, where nothing else is asked for
TILE = 200
#: motion that is followed over the edge of a tile, in sensor pixels; what moves further is searched inside
FAR = 48
#: sensor pixels around the tiles that move in which motion is estimated, where a tolerance is given
AROUND = 24
#: how far two parts are blended into each other, where a tolerance is given
BLEND = 4


@torch.no_grad()
def forward_in_tiles(
    network: Network,
    spikes: Tensor,
    tile: int,
    tolerance: float = 0.0,
    flow: Tensor | None = None,
    static: bool = False,
    done: Callable[[float], object] | None = None,
) -> Tensor:
    r"""Run a network on tiles that overlap, and put the results together.

    Motion, where none is given, is estimated once, on the whole clip. What a network sees around a tile, its ``halo``
    and as far as motion reaches, is computed and thrown away. A network whose ``halo`` is None is run on the whole
    picture, whatever the tile and the tolerance.

    With a tolerance the clip is looked at first, see :mod:`lightning_modules.inference.scene_activity`, and every tile
    gets what it needs: a part without texture the smooth mean of all frames and no network, a tile without motion the
    network but no flow and no search along it. Motion is estimated once, on the part around all tiles that move. Tiles
    overlap by less, and are blended into each other.

    Args:
        network: any of :mod:`lightning_modules.networks`.
        spikes: :math:`(B, N, H, W)`. Of several clips each part gets what the most demanding one needs.
        tile: side of a tile in sensor pixels, even so that the Bayer phase is kept; 0 for no tiles. With a tolerance
            it is a multiple of the cells that are looked at, the next smaller one.
        tolerance: by how many dB the PSNR of the picture is expected to fall at most; 0 for everything everywhere.
        flow: as the network takes it; when not given, the network's own estimate.
        static: nothing moves, instead of a flow.
        done: called after every tile, with the share of them that is done.

    Returns:
        rgb :math:`(B, 3, s H, s W)`.
    """
    if network.halo is None:
        return network(spikes, flow, static)
    if tolerance:
        return _forward_where_needed(network, spikes, tile, tolerance, flow, static, done)
    height, width = spikes.shape[-2:]
    if not tile or max(height, width) <= tile:
        return network(spikes, flow, static)
    flow = network.resolve_flow(spikes, flow, static)
    whole = Box(0, 0, height, width)

    def run(outer: Box) -> Tensor:
        return network(outer.of(spikes), None if flow is None else outer.of(flow), flow is None)

    return tiled(run, whole, tile, lambda box: reach(flow, box, whole, network.halo), network.scale, done)


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


def _around(cells: Tensor) -> Box:
    """Box around the cells that are true, in cells."""
    rows, columns = (cells.any(dim=axis).nonzero() for axis in (1, 0))
    return Box(int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1)


def _boxes(network: Tensor, motion: Tensor, tile: int) -> dict[Box, bool]:
    """The part of every tile of so many cells that needs the network, in cells, and whether it moves."""
    boxes = {}
    for top in range(0, network.shape[0], tile):
        for left in range(0, network.shape[1], tile):
            cells = network[top : top + tile, left : left + tile]
            if cells.any():
                box = _around(cells)
                box = Box(top + box.top, left + box.left, top + box.bottom, left + box.right)
                boxes[box] = bool(box.of(motion).any())
    return boxes


def _forward_where_needed(
    network: Network,
    spikes: Tensor,
    tile: int,
    tolerance: float,
    given: Tensor | None,
    static: bool,
    done: Callable[[float], object] | None,
) -> Tensor:
    height, width = spikes.shape[-2:]
    s, halo = network.scale, max(network.halo, 2 * BLEND)  # what is blended is seen as well
    seen = look(spikes, s, network.pattern, network.settings["alpha"], network.error_model)
    cells = required(seen, tolerance)
    boxes = _boxes(*cells, max(tile // CELL, 1) if tile else max(cells[0].shape))
    boxes = {Box(*(CELL * side for side in box)): moves for box, moves in boxes.items()}
    whole, flow = Box(0, 0, height, width), None
    if any(boxes.values()):
        tops, lefts, bottoms, rights = zip(*(box for box, moves in boxes.items() if moves), strict=True)
        around = Box(min(tops), min(lefts), max(bottoms), max(rights)).grown(AROUND, whole)
        flow = network.resolve_flow(around.of(spikes), None if given is None else around.of(given), static)
    rgb = seen.picture
    for box, moves in _told(boxes.items(), done):
        if moves and flow is not None:
            outer = box.grown(reach(flow, box, around, halo), around)
            part = network(outer.of(spikes), outer.of(flow, around[:2]))
        else:
            outer = box.grown(halo, whole)
            part = network(outer.of(spikes), static=True)
        inner = box.grown(BLEND, whole)
        rows, columns = (
            _ramp(begin, end, inner_begin, inner_end, s, rgb)
            for begin, end, inner_begin, inner_end in zip(box[:2], box[2:], inner[:2], inner[2:], strict=True)
        )
        inner.of(rgb, scale=s).lerp_(inner.of(part.to(rgb), outer[:2], s), rows[:, None] * columns)
    return rgb


def _ramp(begin: int, end: int, inner_begin: int, inner_end: int, scale: int, like: Tensor) -> Tensor:
    """Weights from the inner begin to the inner end: 1 from begin to end, falling to 0 over BLEND sensor pixels."""
    at = torch.arange(scale * inner_begin, scale * inner_end, device=like.device, dtype=like.dtype) + 0.5
    outside = torch.maximum(scale * begin - at, at - scale * end).clamp(min=0)
    return 1 - outside / (scale * BLEND)
