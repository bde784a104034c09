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

_PIECE = 1 << 18  # numbers that are worked on at a time


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
