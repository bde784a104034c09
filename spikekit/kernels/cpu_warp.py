"""The warp on the CPU: rows of channels, gathered and weighed by ``embedding_bag``, in pieces that fit the cache.

The gather's kernels are for many channels, or for channels that lie side by side; for a few planes the torch path is
faster. Copies that are not contiguous are NumPy's: torch would share each small one among its threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.check import wide_dtype
from spikekit.kernels.layout import empty_like_layout, is_channels_last, new_tensor
from spikekit.kernels.position_table import PositionTable, TableAxis

_PIECE = 1 << 18  # numbers that are gathered at a time
_TILE = 1 << 13  # positions that are searched at a time


def _new_like_layout(values: Tensor, size: int, numpy_new: Callable[..., np.ndarray] = np.empty) -> Tensor:
    return empty_like_layout(values, size, lambda shape: new_tensor(shape, values.dtype, numpy_new))


def _array(values: Tensor) -> np.ndarray:
    return (values.view(torch.int16) if values.dtype is torch.bfloat16 else values).numpy()


def _pieces(length: int, width: int) -> Iterator[slice]:
    size = max(_PIECE // width, 64)
    for begin in range(0, length, size):
        yield slice(begin, begin + size)


def _rows(planes: Tensor, dtype: torch.dtype) -> Tensor:
    """(C, P) as (P, C), side by side in memory."""
    rows = planes.t()
    if rows.is_contiguous() and rows.dtype == dtype:
        return rows
    result = new_tensor(tuple(rows.shape), dtype)
    for piece in _pieces(*rows.shape):
        result[piece].copy_(planes[:, piece].contiguous().t())  # torch transposes quickly what is contiguous
    return result


def _used_rows(planes: Tensor, index: np.ndarray, dtype: torch.dtype) -> tuple[Tensor, np.ndarray | None]:
    """Return the rows of (C, P) that the index reads, and where each is among them; None where all are there."""
    channels, pixels = planes.shape
    if planes.t().is_contiguous() and planes.dtype == dtype:
        return planes.t(), None
    used = np.zeros(pixels, bool)
    used[index] = True
    pixel = np.flatnonzero(used)
    place = np.empty(pixels, np.int32)
    place[pixel] = np.arange(len(pixel), dtype=np.int32)
    rows = new_tensor((len(pixel), channels), dtype)
    for piece in _pieces(len(pixel), channels):
        rows[piece].copy_(planes.index_select(1, torch.from_numpy(pixel[piece])).t())
    return rows, place


def _bags(index: np.ndarray, place: np.ndarray | None, piece: slice) -> np.ndarray:
    """Return a piece of an index (K, Q) as bags (q, K)."""
    bags = index[:, piece].T
    return np.ascontiguousarray(bags) if place is None else place.take(bags)


def weighted_gather(values: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Rows are made of what is read only; the sums of a piece are transposed while they are in the cache."""
    out, dtype = _new_like_layout(values, index.shape[2]), wide_dtype(values, weight)
    for planes, index_b, weight_b, out_b in zip(values.detach(), index.numpy(), weight.detach(), out, strict=True):
        rows, place = _used_rows(planes, index_b, dtype)
        for piece in _pieces(*out_b.t().shape):
            bags, weights = torch.from_numpy(_bags(index_b, place, piece)), weight_b[:, piece].t().to(dtype)
            sums = F.embedding_bag(bags, rows, mode="sum", per_sample_weights=weights.contiguous()).to(out.dtype).t()
            _array(out_b)[:, piece] = _array(sums if is_channels_last(out) else sums.contiguous())
    return out


def weighted_scatter(grad: Tensor, index: Tensor, weight: Tensor, size: int) -> Tensor:
    """Sorted by pixel, what arrives at one is a bag: a gather again."""
    out, dtype = _new_like_layout(grad, size, np.zeros), wide_dtype(grad, weight)
    for planes, index_b, weight_b, out_b in zip(grad.detach(), index.numpy(), weight.detach(), out, strict=True):
        pixel, order = torch.from_numpy(index_b.ravel().astype(np.int32)).sort(stable=True)
        first = np.flatnonzero(np.diff(pixel.numpy(), prepend=-1))
        pixel = pixel.numpy()[first]
        sums = F.embedding_bag(
            order % index_b.shape[1],
            _rows(planes, dtype),
            torch.from_numpy(first),
            mode="sum",
            per_sample_weights=torch.from_numpy(weight_b.to(dtype).numpy().ravel().take(order.numpy())),
        ).to(out.dtype)
        if is_channels_last(out):
            _array(out_b.t())[pixel] = _array(sums)
            continue
        for out_c, sums_c in zip(_array(out_b), _array(sums.t().contiguous()), strict=True):
            out_c[pixel] = sums_c
    return out


def weighted_dot(values: Tensor, grad: Tensor, index: Tensor) -> Tensor:
    """Products of rows, a piece at a time."""
    dtype = wide_dtype(values, grad)
    out = new_tensor(tuple(index.shape), dtype)
    for planes, grad_b, index_b, out_b in zip(values.detach(), grad.detach(), index.numpy(), out.numpy(), strict=True):
        rows, place = _used_rows(planes, index_b, dtype)
        for piece in _pieces(*grad_b.t().shape):
            other = _rows(grad_b[:, piece], dtype).numpy()
            for index_k, out_k in zip(index_b[:, piece], out_b[:, piece], strict=True):
                gathered = rows.numpy().take(index_k if place is None else place.take(index_k), axis=0)
                np.einsum("qc,qc->q", gathered, other, out=out_k)
    return out


_Pixels = tuple[np.ndarray, np.ndarray]  # squared distance and flat index, both less those of a common reference
_Ranked = list[_Pixels]


def nearest_four(flow: Tensor, products: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Four nearest pixels of one or two products of rows and columns, in closed form, and their weights.

    The four of a product are one of five Young diagrams over the order of the rows and that of the columns; three
    comparisons tell which. The first four of two sorted lists are the smaller ones of pairs, one list taken backwards.
    """
    count, _, height, width = flow.shape
    plane = height * width
    steps = [tuple(_steps(table.numpy()) for table in product) for product in products]
    index, weight = new_tensor((count, 4, plane), torch.int64), new_tensor((count, 4, plane), flow.dtype)
    moved = flow.detach().flatten(2).numpy()
    pixel_x, pixel_y = np.tile(np.arange(1.0 * width), height), np.repeat(np.arange(1.0 * height), width)
    for images in _slices(count, max(_TILE // plane, 1)):
        for piece in _slices(plane, _TILE):
            x = _Axis(moved[images, 0, piece], pixel_x[piece], width)
            y = _Axis(moved[images, 1, piece], pixel_y[piece], height)
            four, nearest = _nearest_four(x, y, steps, width)
            zero, reference = x.away * x.away + y.away * y.away, y.reference * width + x.reference
            squares = [nearest, *(square + zero for square, _ in four[1:])]
            first, *others = [np.sqrt(square.astype(moved.dtype)) for square in squares]
            flats = [flat + reference for _, flat in four]
            _store(index[images, :, piece], weight[images, :, piece], flats, [first / other for other in others])
    return index, weight


def nearest_in_table(flow: Tensor, table: PositionTable) -> tuple[Tensor, Tensor]:
    """Nearest pixels of rounded positions, and their weights, from a table."""
    count, _, height, width = flow.shape
    plane, neighbors = height * width, len(table.shift)
    index, weight = (
        new_tensor((count, neighbors, plane), torch.int64),
        new_tensor((count, neighbors, plane), flow.dtype),
    )
    moved, shift, share = flow.detach().flatten(2).numpy(), table.shift.numpy(), table.weight.numpy()
    pixels = np.arange(plane, dtype=np.int32)
    pixel_x, pixel_y = pixels % width, pixels // width
    for images in _slices(count, max(_TILE // plane, 1)):
        for piece in _slices(plane, _TILE):
            place, pixel = _on_table(moved[images, 0, piece], pixel_x[piece], table.columns)
            row, y = _on_table(moved[images, 1, piece], pixel_y[piece], table.rows)
            place += row * np.int32(table.columns_length)
            pixel += y * np.int32(width)
            for k in range(neighbors):
                np.add(shift[k].take(place), pixel, out=index.numpy()[images, k, piece])
                weight.numpy()[images, k, piece] = share[k].take(place)
    return index, weight


def _on_table(flow: np.ndarray, pixel: np.ndarray, axis: TableAxis) -> tuple[np.ndarray, np.ndarray]:
    """Return where a coordinate is in the table, and the pixel that it is looked up from, both int32."""
    reach = axis.length + 1.0  # farther away nothing changes, and steps would not fit
    step = np.rint(np.maximum(np.minimum(flow, reach), -reach) * axis.steps).astype(np.int32)
    whole = (step + np.int32(axis.steps // 2)) // np.int32(axis.steps)
    cell = whole + pixel
    inside = np.maximum(np.minimum(cell, np.int32(axis.length - 1)), np.int32(0))
    offset = step - (whole - (cell - inside)) * np.int32(axis.steps)
    offset = np.maximum(np.minimum(offset, np.int32(axis.half)), np.int32(-axis.half))
    return axis.place.numpy().take(inside).astype(np.int32) + offset, inside


def _slices(length: int, size: int) -> Iterator[slice]:
    return (slice(begin, begin + size) for begin in range(0, length, size))


def _steps(table: np.ndarray) -> np.ndarray:
    """Return positions relative to the reference of their half of a pixel."""
    return table - np.arange(table.shape[1]) // 2.0


class _Axis:
    """Where a coordinate is: in which half of a pixel, the reference, and how far from it."""

    def __init__(self, flow: np.ndarray, pixel: np.ndarray, length: int) -> None:
        flow = flow.astype(np.float64)  # so that what is nearer does not depend on rounding
        whole = np.rint(flow)
        part = flow - whole
        cell = whole + pixel
        half = np.ceil(part + part) + (cell + cell)
        self.half = np.maximum(np.minimum(half, 2.0 * length - 1), 0.0).astype(np.intp)
        self.reference = (self.half >> 1).astype(np.float64)
        self.away = (self.reference - cell) - part

    def ranked(self, steps: np.ndarray) -> _Ranked:
        taken = [step.take(self.half) for step in steps]
        # (p - q)^2 - (r - q)^2 without squaring what is far away
        twice = self.away + self.away
        return [(step * (step + twice), step) for step in taken]


def _nearest_four(x: _Axis, y: _Axis, steps: list[tuple[np.ndarray, ...]], width: int) -> tuple[_Ranked, np.ndarray]:
    """Return the four, and the squared distance of the first, which a difference would leave inexact."""
    lists, squares = [], []
    for row_steps, column_steps in steps:
        rows, columns = y.ranked(row_steps), x.ranked(column_steps)
        squares.append((rows[0][1] + y.away) ** 2 + (columns[0][1] + x.away) ** 2)
        lists.append(_four_of_product([(square, step * width) for square, step in rows], columns))
    four = lists[0] if len(lists) == 1 else _four_of_both(*lists)
    return four, np.minimum(squares[0], squares[-1])


def _nearer(one: _Pixels, other: _Pixels, earlier: np.ndarray) -> _Pixels:
    """Choose ``one`` where it is nearer, or as near and ``earlier`` in row-major order."""
    choice = (one[0] < other[0]) | ((one[0] == other[0]) & earlier)
    return np.minimum(one[0], other[0]), np.where(choice, one[1], other[1])


def _four_of_product(rows: _Ranked, columns: _Ranked) -> _Ranked:
    def at(i: int, j: int) -> _Pixels:
        return rows[i][0] + columns[j][0], rows[i][1] + columns[j][1]

    def above(i: int, j: int) -> np.ndarray:
        return rows[i][1] < rows[j][1]

    corner, column = _nearer(at(1, 1), at(0, 2), above(1, 0)), at(2, 0)
    return [
        at(0, 0),
        _nearer(at(3, 0), at(0, 1), above(3, 0)),
        _nearer(at(1, 0), at(0, 3), above(1, 0)),
        _nearer(column, corner, column[1] < corner[1]),
    ]


def _in_order(one: _Pixels, other: _Pixels) -> tuple[_Pixels, _Pixels]:
    choice = (one[0] < other[0]) | ((one[0] == other[0]) & (one[1] < other[1]))
    return (
        (np.minimum(one[0], other[0]), np.where(choice, one[1], other[1])),
        (np.maximum(one[0], other[0]), np.where(choice, other[1], one[1])),
    )


def _four_of_both(first: _Ranked, second: _Ranked) -> _Ranked:
    for ranked in (first, second):  # the nearest is in its place already
        for i, j in (1, 2), (2, 3), (1, 2):
            ranked[i], ranked[j] = _in_order(ranked[i], ranked[j])
    four = [_nearer(one, other, one[1] < other[1]) for one, other in zip(first, reversed(second), strict=True)]
    four[0], four[3] = _in_order(four[0], four[3])
    return four


def _store(index: Tensor, weight: Tensor, flats: list[np.ndarray], ratios: list[np.ndarray]) -> None:
    """Write (n, K, p) of what is nearest, and weights of sum 1 from 1 / d, relative to the nearest: d_1 / d_k.

    So nothing overflows next to a pixel, and on it the others have none.
    """
    share = 1 / (1 + sum(ratios))
    for k, flat in enumerate(flats):
        index.numpy()[:, k] = flat
        weight.numpy()[:, k] = share if k == 0 else ratios[k - 1] * share
