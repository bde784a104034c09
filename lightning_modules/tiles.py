"""Large recordings in bounded memory: a network run tile by tile, and only where the scene needs it."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from lightning_modules.look import CELL, look, required
from lightning_modules.motion import ZeroFlow
from lightning_modules.networks import Network

#: side of a tile, in sensor pixels, where nothing else is asked for
TILE = 128
#: sensor pixels around a tile that are computed and thrown away, beside those that motion reaches over: what shipped
#: networks see beyond them changes a picture by less than a thirtieth of a step of 8 bits
HALO = 12
#: motion that is followed over the edge of a tile, in sensor pixels; what moves further is searched inside
FAR = 48
#: sensor pixels around the tiles that move in which motion is estimated, where a tolerance is given
AROUND = 24
#: how far two parts are blended into each other, where a tolerance is given
BLEND = 4


@torch.no_grad()
def forward_in_tiles(
    network: Network, spikes: Tensor, tile: int, tolerance: float = 0.0, flow: Tensor | Literal[0] | None = None
) -> Tensor:
    r"""Run a network on tiles that overlap, and put the results together.

    Motion, where none is given, is estimated once, on the whole clip.

    With a tolerance the clip is looked at first, see :mod:`lightning_modules.look`, and every tile gets what it needs:
    a part without texture the smooth mean of all frames and no network, a tile without motion the network but no flow
    and no search along it. Motion is estimated once, on the part around all tiles that move. Tiles overlap by less,
    and are blended into each other.

    Args:
        network: any of :mod:`lightning_modules.networks`.
        spikes: :math:`(B, N, H, W)`. Of several clips each part gets what the most demanding one needs.
        tile: side of a tile in sensor pixels, even so that the Bayer phase is kept; 0 for no tiles. With a tolerance
            it is a multiple of the cells that are looked at, the next smaller one.
        tolerance: by how many dB the PSNR of the picture is expected to fall at most; 0 for everything everywhere.
        flow: as the network takes it; when not given, the network's own estimate.

    Returns:
        rgb :math:`(B, 3, s H, s W)`.
    """
    if tolerance:
        return _forward_where_needed(network, spikes, tile, tolerance, flow)
    height, width = spikes.shape[-2:]
    if not tile or max(height, width) <= tile:
        return network(spikes, flow)
    flow, s = _motion(network, spikes) if flow is None else flow, network.scale
    whole, rgb = Box(0, 0, height, width), None
    for top in range(0, height, tile):
        for left in range(0, width, tile):
            box = Box(top, left, top + tile, left + tile).grown(0, whole)
            outer = box.grown(_reach(flow, box, whole), whole)
            part = network(outer.of(spikes), outer.of(flow) if isinstance(flow, Tensor) else flow)
            if rgb is None:
                rgb = part.new_empty(*part.shape[:-2], s * height, s * width)
            box.of(rgb, scale=s).copy_(box.of(part, outer[:2], s))
    return rgb


def _motion(network: Network, spikes: Tensor) -> Tensor | Literal[0]:
    return 0 if isinstance(network.motion, ZeroFlow) else network.estimate_flow(spikes)


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


def _reach(flow: Tensor | Literal[0], box: Box, frame: Box) -> int:
    """How much around a box of a frame a network has to see: even, as the Bayer phase is kept."""
    if not isinstance(flow, Tensor):
        return HALO
    near = box.grown(HALO, frame).of(flow, frame[:2])
    return HALO + 2 * math.ceil(near.nan_to_num().abs().amax().clamp(max=FAR).item() / 2)


def _around(cells: Tensor) -> Box:
    """Box around the cells that are true, in cells."""
    rows, columns = (cells.any(dim=axis).nonzero() for axis in (1, 0))
    return Box(int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1)


def _boxes(network: Tensor, motion: Tensor, tile: int) -> dict[Box, bool]:
    """What the network has to see of every tile of so many cells, in cells, and whether it moves."""
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
    network: Network, spikes: Tensor, tile: int, tolerance: float, given: Tensor | Literal[0] | None
) -> Tensor:
    height, width = spikes.shape[-2:]
    s = network.scale
    seen = look(spikes, s, network.pattern, network.settings["alpha"])
    cells = required(seen, tolerance)
    boxes = _boxes(*cells, max(tile // CELL, 1) if tile else max(cells[0].shape))
    boxes = {Box(*(CELL * side for side in box)): moves for box, moves in boxes.items()}
    whole, flow = Box(0, 0, height, width), 0
    if any(boxes.values()):
        tops, lefts, bottoms, rights = zip(*(box for box, moves in boxes.items() if moves), strict=True)
        around = Box(min(tops), min(lefts), max(bottoms), max(rights)).grown(AROUND, whole)
        if given is None:
            flow = _motion(network, around.of(spikes))
        else:
            flow = around.of(given) if isinstance(given, Tensor) else given
    rgb = seen.picture
    for box, moves in boxes.items():
        if moves and isinstance(flow, Tensor):
            outer = box.grown(_reach(flow, box, around), around)
            part = network(outer.of(spikes), outer.of(flow, around[:2]))
        else:
            outer = box.grown(HALO, whole)
            part = network(outer.of(spikes), 0)
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
