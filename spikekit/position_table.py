"""A table of the nearest known pixels, and their weights, for positions rounded to fractions of a pixel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

_CHUNK = 1 << 15  # positions that are searched at a time
_LARGEST = 1 << 23  # positions of a table: 128 MiB of four neighbours


class TableAxis:
    """Rounded positions on one axis, in classes: a pixel near a border is its own, the others share the period's.

    Args:
        length: pixels.
        period: after how many of them the mask repeats.
        margin: how near to a border a pixel is its own class.
        steps: positions per pixel.
        device: of the mask.
    """

    def __init__(self, length: int, period: int, margin: int, steps: int, device: str) -> None:
        self.length = length
        self.steps = steps
        self.half = (steps + 1) // 2  # rounded positions on either side of a pixel
        pixel = np.arange(length)
        place = pixel
        if length > 2 * margin + period:
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
        steps: positions per pixel and axis.
        search: finds flat indices and weights, both (neighbors, n), for pixels (2, n), (x, y), and offsets (2, n), on
            the CPU.
        dtype: of the weights.
        device: of the mask.

    Raises:
        ValueError: the mask has no period, and is so large that the table would be huge.
    """

    def __init__(
        self,
        known: np.ndarray,
        neighbors: int,
        steps: int,
        search: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
        dtype: torch.dtype,
        device: str,
    ) -> None:
        height, self.width = known.shape
        period = _period(known), _period(known.T)
        margin = _margin(known, period, neighbors)
        self.rows = TableAxis(height, period[0], margin, steps, device)
        self.columns = TableAxis(self.width, period[1], margin, steps, device)
        (y, y_offset), (x, x_offset) = self.rows.positions(), self.columns.positions()
        if len(y) * len(x) > _LARGEST:
            raise ValueError(
                f"mask: expected a pattern that repeats along rows and columns, got one whose table of steps={steps} "
                f"would have {len(y) * len(x)} positions"
            )
        self.columns_length = len(x)
        cell = torch.stack([x.repeat(len(y)), y.repeat_interleave(len(x))])
        part = torch.stack([x_offset.repeat(len(y)), y_offset.repeat_interleave(len(x))])
        parts = zip(cell.split(_CHUNK, dim=1), part.split(_CHUNK, dim=1), strict=True)
        found = [(index.int(), weight.to(dtype)) for index, weight in (search(*pair) for pair in parts)]
        nearest, weight = (torch.cat(kind, dim=1) for kind in zip(*found, strict=True))
        self.shift = (nearest - (cell[1] * self.width + cell[0])).int().to(device)  # from the pixel to its neighbours
        self.weight = weight.to(device)

    def find(self, cell: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        """Flat indices and weights, both (neighbors, n), for cell + part, (2, n)."""
        column, x = self.columns.find(cell[0], part[0])
        row, y = self.rows.find(cell[1], part[1])
        place = row * self.columns_length + column
        return self.shift.index_select(1, place) + (y * self.width + x), self.weight.index_select(1, place)


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
