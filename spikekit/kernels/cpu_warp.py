"""The warp on the CPU: rows of channels, gathered and weighed by ``embedding_bag``, in pieces that fit the cache.

The gather's kernels are for many channels, or for channels that lie side by side; for a few planes the torch path is
faster. Copies that are not contiguous are NumPy's: torch would share each small one among its threads.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.kernels.layout import empty_like_layout, is_channels_last

_PIECE = 1 << 18  # numbers that are gathered at a time
_TILE = 1 << 13  # positions that are searched at a time


def _empty(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """From NumPy, which asks for huge pages."""
    return torch.from_numpy(np.empty(shape, f"i{dtype.itemsize}")).view(dtype)


def _empty_like_layout(values: Tensor, size: int) -> Tensor:
    return empty_like_layout(values, size, lambda shape: _empty(shape, values.dtype))


def _array(values: Tensor) -> np.ndarray:
    return (values.view(torch.int16) if values.dtype is torch.bfloat16 else values).numpy()


def _wide(*tensors: Tensor) -> torch.dtype:
    return torch.float64 if torch.float64 in [tensor.dtype for tensor in tensors] else torch.float32


def _pieces(length: int, width: int) -> Iterator[slice]:
    size = max(_PIECE // width, 64)
    for begin in range(0, length, size):
        yield slice(begin, begin + size)


def _rows(planes: Tensor, dtype: torch.dtype) -> Tensor:
    """(C, P) as (P, C), side by side in memory."""
    rows = planes.t()
    if rows.is_contiguous() and rows.dtype == dtype:
        return rows
    result = _empty(tuple(rows.shape), dtype)
    for piece in _pieces(*rows.shape):
        # two steps, each of which torch does quickly
        result[piece].copy_(planes[:, piece].contiguous().t().contiguous())
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
    rows = _empty((len(pixel), channels), dtype)
    for piece in _pieces(len(pixel), channels):
        rows[piece].copy_(planes.index_select(1, torch.from_numpy(pixel[piece])).t())
    return rows, place


def _bags(index: np.ndarray, place: np.ndarray | None, piece: slice) -> np.ndarray:
    """Return a piece of an index (K, Q) as bags (q, K)."""
    bags = index[:, piece].T
    return np.ascontiguousarray(bags) if place is None else place.take(bags)


def weighted_gather(values: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Rows are made of what is read only; the sums of a piece are transposed while they are in the cache."""
    out, dtype = _empty_like_layout(values, index.shape[2]), _wide(values, weight)
    for planes, index_b, weight_b, out_b in zip(values.detach(), index.numpy(), weight.detach(), out, strict=True):
        rows, place = _used_rows(planes, index_b, dtype)
        for piece in _pieces(*out_b.t().shape):
            bags, weights = torch.from_numpy(_bags(index_b, place, piece)), weight_b[:, piece].t().to(dtype)
            sums = F.embedding_bag(bags, rows, mode="sum", per_sample_weights=weights.contiguous()).to(out.dtype).t()
            _array(out_b)[:, piece] = _array(sums if is_channels_last(out) else sums.contiguous())
    return out


def weighted_scatter(grad: Tensor, index: Tensor, weight: Tensor, size: int) -> Tensor:
    """Sorted by pixel, what arrives at one is a bag: a gather again."""
    out, dtype = _empty_like_layout(grad, size).zero_(), _wide(grad, weight)
    for planes, index_b, weight_b, out_b in zip(grad.detach(), index.numpy(), weight.detach(), out, strict=True):
        order = np.argsort(index_b.ravel().astype(np.int32), kind="stable")
        pixel = index_b.ravel()[order]
        first = np.flatnonzero(np.diff(pixel, prepend=-1))
        sums = F.embedding_bag(
            torch.from_numpy(order % index_b.shape[1]),
            _rows(planes, dtype),
            torch.from_numpy(first),
            mode="sum",
            per_sample_weights=weight_b.to(dtype).ravel()[torch.from_numpy(order)],
        ).to(out.dtype)
        if is_channels_last(out):
            _array(out_b.t())[pixel[first]] = _array(sums)
            continue
        for out_c, sums_c in zip(_array(out_b), _array(sums.t().contiguous()), strict=True):
            out_c[pixel[first]] = sums_c
    return out


def weighted_dot(values: Tensor, grad: Tensor, index: Tensor) -> Tensor:
    """Products of rows, a piece at a time."""
    dtype = _wide(values, grad)
    out = _empty(tuple(index.shape), dtype)
    width = values.shape[1] * index.shape[1]
    for planes, grad_b, index_b, out_b in zip(values.detach(), grad.detach(), index.numpy(), out.numpy(), strict=True):
        rows, place = _used_rows(planes, index_b, dtype)
        for piece in _pieces(index.shape[2], width):
            gathered = rows.numpy().take(_bags(index_b, place, piece), axis=0)
            out_b[:, piece] = np.einsum("qkc,qc->kq", gathered, _rows(grad_b[:, piece], dtype).numpy())
    return out


_Position = tuple[np.ndarray, np.ndarray]  # whole and fractional part of a coordinate
_Pixels = tuple[np.ndarray, np.ndarray]  # squared distance, less that of a common reference, and where
_Ranked = list[_Pixels]


def nearest_four(flow: Tensor, products: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Four nearest pixels of one or two products of rows and columns, in closed form, and their weights.

    The four of a product are one of five Young diagrams over the order of the rows and that of the columns; three
    comparisons tell which. The first four of two sorted lists are the smaller ones of pairs, one list taken backwards.
    """
    count, _, height, width = flow.shape
    plane = height * width
    row_tables, column_tables = ([table.numpy() for table in tables] for tables in zip(*products, strict=True))
    index, weight = _empty((count, 4, plane), torch.int64), _empty((count, 4, plane), flow.dtype)
    moved = flow.detach().flatten(2).numpy()
    for images in _slices(count, max(_TILE // plane, 1)):
        for piece in _slices(plane, _TILE):
            pixel = np.arange(plane)[piece]
            x, columns = _on_axis(moved[images, 0, piece], pixel % width, column_tables)
            y, rows = _on_axis(moved[images, 1, piece], pixel // width, row_tables)
            nearest = [_four_of_product(*pair, width) for pair in zip(rows, columns, strict=True)]
            four = _four_of_both(*nearest) if len(nearest) == 2 else nearest[0]
            shares = _weigh(four, width, x, y, moved.dtype)
            for k, ((_, flat), share) in enumerate(zip(four, shares, strict=True)):
                index.numpy()[images, k, piece], weight.numpy()[images, k, piece] = flat, share
    return index, weight


def _slices(length: int, size: int) -> Iterator[slice]:
    return (slice(begin, begin + size) for begin in range(0, length, size))


def _on_axis(flow: np.ndarray, pixel: np.ndarray, tables: list[np.ndarray]) -> tuple[_Position, list[_Ranked]]:
    """Return where a coordinate is, and what is nearest to it in every table."""
    flow = flow.astype(np.float64)  # so that what is nearer does not depend on rounding
    whole = np.rint(flow)
    part = flow - whole
    cell = whole + pixel
    half = np.clip(2 * cell + np.ceil(2 * part), 0, tables[0].shape[1] - 1).astype(np.intp)
    reference = (half >> 1).astype(np.float64)
    twice = 2 * ((reference - cell) - part)
    ranked = []
    for table in tables:
        steps = [positions.take(half) for positions in table - np.arange(table.shape[1]) // 2.0]
        # (p - q)^2 - (r - q)^2 without squaring what is far away
        ranked.append([(step * (step + twice), step + reference) for step in steps])
    return (cell, part), ranked


def _before(one: np.ndarray, other: np.ndarray, lower: np.ndarray) -> np.ndarray:
    return (one < other) | ((one == other) & lower)


def _four_of_product(rows: _Ranked, columns: _Ranked, width: int) -> _Ranked:
    (b0, y0), (b1, y1), (b2, y2), (b3, y3) = rows
    (a0, x0), (a1, x1), (a2, x2), (a3, x3) = columns
    y0, y1, y2, y3 = (y * width for y in (y0, y1, y2, y3))
    second, row_4 = a1 + b0, a0 + b3
    swap = _before(row_4, second, y3 < y0)
    ranked = [(a0 + b0, y0 + x0), (np.where(swap, row_4, second), np.where(swap, y3 + x0, y0 + x1))]
    column_4, row_2 = a3 + b0, a0 + b1
    swap = _before(row_2, column_4, y1 < y0)
    ranked.append((np.where(swap, row_2, column_4), np.where(swap, y1 + x0, y0 + x3)))
    column_3, corner, row_3 = a2 + b0, a1 + b1, a0 + b2
    swap = _before(corner, column_3, y1 < y0)
    distance, flat = np.where(swap, corner, column_3), np.where(swap, y1 + x1, y0 + x2)
    swap = _before(row_3, distance, y2 + x0 < flat)
    return [*ranked, (np.where(swap, row_3, distance), np.where(swap, y2 + x0, flat))]


def _in_order(one: _Pixels, other: _Pixels) -> tuple[_Pixels, _Pixels]:
    swap = _before(other[0], one[0], other[1] < one[1])
    return (
        (np.minimum(one[0], other[0]), np.where(swap, other[1], one[1])),
        (np.maximum(one[0], other[0]), np.where(swap, one[1], other[1])),
    )


def _four_of_both(*products: _Ranked) -> _Ranked:
    for ranked in products:  # the first is in its place already
        for i, j in (1, 2), (2, 3), (1, 2):
            ranked[i], ranked[j] = _in_order(ranked[i], ranked[j])
    ranked = [_in_order(*pair)[0] for pair in zip(products[0], reversed(products[1]), strict=True)]
    ranked[0], ranked[3] = _in_order(ranked[0], ranked[3])
    return ranked


def _weigh(four: _Ranked, width: int, x: _Position, y: _Position, dtype: np.dtype) -> list[np.ndarray]:
    """Weights by inverse distance, relative to the nearest, so that nothing overflows; on a pixel it has them all."""
    distance = []
    for _, flat in four:
        row = np.floor(flat / width)
        dx, dy = ((flat - row * width - x[0]) - x[1]).astype(dtype), ((row - y[0]) - y[1]).astype(dtype)
        distance.append(np.sqrt(dx * dx + dy * dy))
    others = [distance[0] / d for d in distance[1:]]
    share = 1 / (1 + others[0] + others[1] + others[2])
    return [share, *(other * share for other in others)]
