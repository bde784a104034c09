"""A table of the nearest known pixels, and their weights, for positions rounded to fractions of a pixel."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

_CHUNK = 1 << 15  # positions that are searched at a time
_LARGEST = 1 << 23  # positions of a table: 128 MiB of four neighbours

Search = Callable[[np.ndarray, int, Tensor, Tensor], tuple[Tensor, Tensor]]


class TableAxis:
    """Rounded positions on one axis, in classes: a pixel near a border is its own, the others share the period's.

    Args:
        length: pixels.
        period: after how many of them the mask repeats.
        margin: how near to a border a pixel is its own class.
        steps: positions per pixel, even, so that half a pixel, where the picture ends, is one.
        device: of the mask.
    """

    def __init__(self, length: int, period: int, margin: int, steps: int, device: str) -> None:
        self.length = length
        self.steps = steps
        self.half = steps // 2  # rounded positions on either side of a pixel
        pixel = np.arange(length)
        place = pixel
        self.short = length  # of the shortest axis that looks the same from every pixel
        if length > 2 * margin + period:
            self.short = 2 * margin + period + (length - 2 * margin) % period
            inner = np.s_[margin : length - margin]
            place = np.where(pixel < margin, pixel, pixel - (length - 2 * margin - period))
            place[inner] = margin + (pixel[inner] - margin) % period
        _, self.first = np.unique(place, return_index=True)  # a pixel of every class
        # where the class of a pixel begins, plus half: a rounded offset is added to it
        self.place = torch.from_numpy(place * (2 * self.half + 1) + self.half).to(device)

    def positions(self) -> tuple[Tensor, Tensor]:
        """Pixel and offset of everything the table holds."""
        offset = torch.arange(-self.half, self.half + 1, dtype=torch.float64) / self.steps
        pixel = torch.from_numpy(self.first).repeat_interleave(len(offset))
        return pixel, offset.repeat(len(self.first))

    def find(self, cell: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        """Return where cell + part is in the table, and the pixel that it is looked up from."""
        pixel = cell.clamp(0, self.length - 1)
        offset = ((cell - pixel) + part).clamp(-0.5, 0.5) * self.steps
        return self.place[pixel] + offset.round().long(), pixel


class PositionTable:
    """The nearest known pixels of all rounded positions of a mask with a period, and their weights.

    Args:
        known: the mask, bool.
        neighbors: how many pixels are kept for a position.
        steps: positions per pixel and axis, even.
        search: finds flat indices and weights, both (neighbors, n), in a mask, for pixels (2, n), (x, y), and offsets
            (2, n), on the CPU.
        dtype: of the weights.
        device: of the mask.

    Raises:
        ValueError: the mask has no period, and is so large that the table would be huge.
    """

    def __init__(
        self, known: np.ndarray, neighbors: int, steps: int, search: Search, dtype: torch.dtype, device: str
    ) -> None:
        height, self.width = known.shape
        period = _period(known), _period(known.T)
        margin = _margin(known, period, neighbors)
        self.rows = TableAxis(height, period[0], margin, steps, device)
        self.columns = TableAxis(self.width, period[1], margin, steps, device)
        positions = math.prod(len(axis.first) * (2 * axis.half + 1) for axis in (self.rows, self.columns))
        if positions > _LARGEST:
            raise ValueError(
                f"mask: expected a pattern that repeats along rows and columns, got one whose table of steps={steps} "
                f"would have {positions} positions"
            )
        # masks of all sizes share what is found in the smallest that has the same borders
        small = known[: self.rows.short, : self.columns.short]
        y, x, weight = _search_all(small.tobytes(), small.shape, period, margin, neighbors, steps, search)
        self.columns_length = len(self.columns.first) * (2 * self.columns.half + 1)
        self.shift = (y * self.width + x).to(device)  # from the pixel to its neighbours
        self.weight = weight.to(dtype).to(device)

    def find(self, cell: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        """Flat indices and weights, both (neighbors, n), for cell + part, (2, n)."""
        column, x = self.columns.find(cell[0], part[0])
        row, y = self.rows.find(cell[1], part[1])
        place = row * self.columns_length + column
        return self.shift.index_select(1, place) + (y * self.width + x), self.weight.index_select(1, place)


@lru_cache(maxsize=8)
def _search_all(
    bits: bytes, size: tuple[int, int], period: tuple[int, int], margin: int, neighbors: int, steps: int, search: Search
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns from the pixel of every position to its neighbours, int32, and their weights."""
    known = np.frombuffer(bits, bool).reshape(size)
    (y, y_offset), (x, x_offset) = (
        TableAxis(length, repeat, margin, steps, "cpu").positions() for length, repeat in zip(size, period, strict=True)
    )
    cell = torch.stack([x.repeat(len(y)), y.repeat_interleave(len(x))])
    part = torch.stack([x_offset.repeat(len(y)), y_offset.repeat_interleave(len(x))])
    parts = zip(cell.split(_CHUNK, dim=1), part.split(_CHUNK, dim=1), strict=True)
    found = [search(known, neighbors, *pair) for pair in parts]
    index, weight = (torch.cat(kind, dim=1) for kind in zip(*found, strict=True))
    row = index // size[1]
    return (row - cell[1]).int(), (index - row * size[1] - cell[0]).int(), weight


def _period(known: np.ndarray) -> int:
    """Return the smallest shift along the first axis that maps a mask on itself."""
    return next(shift for shift in range(1, len(known) + 1) if (known[shift:] == known[: len(known) - shift]).all())


def _margin(known: np.ndarray, period: tuple[int, int], neighbors: int) -> int:
    """Return how far from a pixel of the picture its nearest known pixels can be."""
    height, width = known.shape
    density = np.count_nonzero(known[: period[0], : period[1]])
    for reach in range(1, max(height, width) + 1):
        # a square of this side, with the pixel in its corner, lies inside the picture or spans it
        cells = (min(reach, height) // period[0]) * (min(reach, width) // period[1])
        if cells * density >= neighbors:
            return int(np.ceil(reach * 2**0.5)) + 1
    return max(height, width)
