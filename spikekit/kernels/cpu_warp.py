"""Warping on the CPU: rows of channels are gathered and weighted by ``embedding_bag``, in pieces that fit the cache.

These kernels are for many channels, or channels last; for a few planes the torch path is faster. Strided copies use
NumPy, as torch would use several threads even for small ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.check import wide_dtype
from spikekit.kernels.layout import empty_like_layout, is_channels_last, new_tensor

_PIECE = 1 << 18  # elements that are gathered at a time


def _new_like_layout(values: Tensor, size: int, numpy_new: Callable[..., np.ndarray] = np.empty) -> Tensor:
    return empty_like_layout(values, size, lambda shape: new_tensor(shape, values.dtype, numpy_new))


def _array(values: Tensor) -> np.ndarray:
    return (values.view(torch.int16) if values.dtype is torch.bfloat16 else values).numpy()


def _pieces(length: int, width: int) -> Iterator[slice]:
    size = max(_PIECE // width, 64)
    for begin in range(0, length, size):
        yield slice(begin, begin + size)


def _rows(planes: Tensor, dtype: torch.dtype) -> Tensor:
    """Return (C, P) as contiguous (P, C)."""
    rows = planes.t()
    if rows.is_contiguous() and rows.dtype == dtype:
        return rows
    result = new_tensor(tuple(rows.shape), dtype)
    for piece in _pieces(*rows.shape):
        result[piece].copy_(planes[:, piece].contiguous().t())  # torch transposes contiguous tensors quickly
    return result


def _used_rows(planes: Tensor, index: np.ndarray, dtype: torch.dtype) -> tuple[Tensor, np.ndarray | None]:
    """Return the rows of (C, P) that the index reads, and the new place of each pixel, or all rows and None."""
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


def weighted_gather(values: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Gather from rows of the pixels that are read; sums of a piece are transposed while they are in the cache."""
    out, dtype = _new_like_layout(values, index.shape[2]), wide_dtype(values, weight)
    for planes, index_b, weight_b, out_b in zip(values.detach(), index.numpy(), weight.detach(), out, strict=True):
        rows, place = _used_rows(planes, index_b, dtype)
        for piece in _pieces(*out_b.t().shape):
            bags, weights = index_b[:, piece].T, weight_b[:, piece].t().to(dtype)
            bags = torch.from_numpy(np.ascontiguousarray(bags) if place is None else place.take(bags))
            sums = F.embedding_bag(bags, rows, mode="sum", per_sample_weights=weights.contiguous()).to(out.dtype).t()
            _array(out_b)[:, piece] = _array(sums if is_channels_last(out) else sums.contiguous())
    return out


def weighted_scatter(grad: Tensor, index: Tensor, weight: Tensor, size: int) -> Tensor:
    """Sort entries by pixel; the entries of each pixel form a bag, as in a gather."""
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
    """Compute products of rows, a piece at a time."""
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
