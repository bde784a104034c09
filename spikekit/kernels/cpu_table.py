"""The warp by a table of positions, position by position, in loops that Numba compiles.

What array operations would carry through memory, indices and weights of every position, never leaves the cache here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from spikekit.kernels.compiled import compiled, in_threads
from spikekit.kernels.position_table import PositionTable

_WORTH_THREADS = 1 << 16  # positions


@compiled
def _look_up(flow, y, axes, row_place, column_place, place, pixel):
    """Where the positions of a row are in the table, and the pixels that they are looked up from."""
    height, width, steps, half, row_length = axes
    far_x, far_y = width + 1.0, height + 1.0  # farther away nothing changes, and steps would not fit
    for x in range(width):
        moved_x, moved_y = flow[0, y, x], flow[1, y, x]
        step_x = np.int32(0 if np.isnan(moved_x) else np.rint(min(max(moved_x, -far_x), far_x) * steps))
        step_y = np.int32(0 if np.isnan(moved_y) else np.rint(min(max(moved_y, -far_y), far_y) * steps))
        # floor division in floating point, which processors do many at a time
        whole_x = np.int32(np.floor((step_x + steps // 2 + 0.5) / steps))
        whole_y = np.int32(np.floor((step_y + steps // 2 + 0.5) / steps))
        cell_x, cell_y = whole_x + np.int32(x), whole_y + np.int32(y)
        in_x = min(max(cell_x, np.int32(0)), width - np.int32(1))
        in_y = min(max(cell_y, np.int32(0)), height - np.int32(1))
        offset_x = min(max(step_x - (whole_x - (cell_x - in_x)) * steps, -half), half)
        offset_y = min(max(step_y - (whole_y - (cell_y - in_y)) * steps, -half), half)
        place[x] = (row_place[in_y] + offset_y) * row_length + column_place[in_x] + offset_x
        pixel[x] = in_y * width + in_x


@compiled
def _warp(planes, flow, axes, row_place, column_place, shift, weight, out, begin, end):
    """Rows ``begin`` to ``end`` of an image, planes (C, H W) to out (C, H, W)."""
    width = axes[1]
    place, pixel, index = np.empty((3, width), np.int32)
    share = np.empty(width, weight.dtype)
    for y in range(begin, end):
        _look_up(flow, y, axes, row_place, column_place, place, pixel)
        for k in range(len(shift)):
            for x in range(width):
                index[x], share[x] = pixel[x] + shift[k, place[x]], weight[k, place[x]]
            for c in range(len(planes)):
                values, row = planes[c], out[c, y]
                for x in range(width):
                    row[x] += values[index[x]] * share[x]


@compiled
def _unwarp(planes, flow, axes, row_place, column_place, shift, weight, out):
    """The transpose, planes (C, H, W) of an image to out (C, H W)."""
    height, width = axes[:2]
    place, pixel, index = np.empty((3, width), np.int32)
    share = np.empty(width, weight.dtype)
    for y in range(height):
        _look_up(flow, y, axes, row_place, column_place, place, pixel)
        for k in range(len(shift)):
            for x in range(width):
                index[x], share[x] = pixel[x] + shift[k, place[x]], weight[k, place[x]]
            for c in range(len(planes)):
                row, sums = planes[c, y], out[c]
                for x in range(width):
                    sums[index[x]] += row[x] * share[x]


def _by_position(table: PositionTable) -> tuple[Any, ...]:
    axes = table.rows.length, table.width, table.rows.steps, table.rows.half, table.columns_length
    place = (axis.place.numpy().astype(np.int32) for axis in (table.rows, table.columns))
    return tuple(map(np.int32, axes)), *place, table.shift.numpy(), table.weight.numpy()


def warp(values: Tensor, flow: Tensor, table: PositionTable) -> Tensor:
    """(N, C, H W) where flow (N, 2, H, W) points to, from a table, in the dtype of ``flow``."""
    count, channels, _ = values.shape
    height, width = flow.shape[-2:]
    planes, moved = values.detach().to(flow.dtype).contiguous().numpy(), flow.detach().contiguous().numpy()
    out = np.zeros((count, channels, height, width), moved.dtype)
    by_position = _by_position(table)
    rows = -(-height // torch.get_num_threads())
    jobs = [
        (planes[n], moved[n], *by_position, out[n], begin, min(begin + rows, height))
        for n in range(count)
        for begin in range(0, height, rows)
    ]
    in_threads(_warp, jobs, worth=count * height * width >= _WORTH_THREADS)
    return torch.from_numpy(out).flatten(2)


def unwarp(grad: Tensor, flow: Tensor, table: PositionTable) -> Tensor:
    """The transpose of :func:`warp`, of the same shapes."""
    count, channels, _ = grad.shape
    height, width = flow.shape[-2:]
    planes = grad.detach().to(flow.dtype).reshape(count, channels, height, width).contiguous().numpy()
    moved = flow.detach().contiguous().numpy()
    out = np.zeros((count, channels, height * width), moved.dtype)
    by_position = _by_position(table)
    jobs = [(planes[n], moved[n], *by_position, out[n]) for n in range(count)]
    in_threads(_unwarp, jobs, worth=count * height * width >= _WORTH_THREADS)
    return torch.from_numpy(out)
