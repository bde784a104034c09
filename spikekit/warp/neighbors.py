"""Nearest known pixels at the positions of a flow, and their inverse-distance weights.

Several warps with the same flow and mask can share them::

    index, weight = idw_neighbors(flow, mask)
    warped = Gather.apply(features.flatten(2), index, weight).reshape(features.shape)
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from spikekit.kernels import custom_operator, gpu_kernel, import_loops, register_kernel, register_vmap

_FARTHEST = 2.0**30  # flow is clamped to it, so that positions fit an integer
_CHUNK = 1 << 15  # positions per search: fits in the cache of one thread

# Tables of the rows and the columns of a product, (k, 2 H) and (k, 2 W), see _nearest_on_axis.
Product = tuple[Tensor, Tensor]


def finite(flow: Tensor) -> Tensor:
    """Replace NaN by 0 and clamp large values, both with gradient 0."""
    return flow.nan_to_num(0.0).clamp(-_FARTHEST, _FARTHEST)


def _nearest_on_axis(known: np.ndarray, length: int, neighbors: int) -> np.ndarray:
    """Return the nearest known indices, nearest first, for every interval ((h - 1) / 2, h / 2].

    Between two half-integers, the order of whole numbers by distance is constant. At h / 2 two may be equally far; the
    lower one wins. The order at q therefore depends on ceil(2 q) only, and is constant outside the axis, so
    2 * length rows cover every q.
    """
    h = np.arange(2 * length)
    # candidates: equally many on both sides of h / 2
    start = np.searchsorted(known, h / 2)[:, None] + np.arange(-neighbors, neighbors)
    outside = (start < 0) | (start >= len(known))
    position = known[start.clip(0, len(known) - 1)]
    distance = np.where(outside, np.inf, np.abs(2 * position - h[:, None]))
    order = np.argsort(distance, axis=1, kind="stable")[:, : min(neighbors, len(known))]
    return np.take_along_axis(position, order, axis=1)


# Content of a mask: (bits, height, width, device). Keyed by identity: a WeakKeyDictionary would compare with ==.
_Key = tuple[bytes, int, int, str]
_key_of_mask = WeakTensorKeyDictionary()


def _key(mask: Tensor) -> _Key:
    """Return the content of a mask, without synchronising a GPU unless the mask is new or has changed."""
    # inference tensors have no version counter, and CPU memory may be shared, for example with NumPy
    uncounted = mask.is_inference() or mask.device.type == "cpu"
    version = None if uncounted else mask._version
    kept, key = _key_of_mask.get(mask, (None, None))
    if version is None or version != kept:
        key = (mask.detach() != 0).cpu().numpy().tobytes(), *mask.shape, str(mask.device)
        if version is not None:
            _key_of_mask[mask] = version, key
    return key


@lru_cache(maxsize=32)
def _products(key: _Key, neighbors: int) -> list[Product]:
    """Decompose a mask into products of known rows and known columns, and return the tables of each.

    Rows with the same known columns form one product, so every mask is a union of products. Red and blue of a Bayer
    filter need one, green needs two.
    """
    bits, height, width, device = key
    rows_of_pattern: dict[bytes, list[int]] = {}
    for row in range(height):
        rows_of_pattern.setdefault(bits[row * width : (row + 1) * width], []).append(row)
    products = []
    for pattern, rows in rows_of_pattern.items():
        columns = np.flatnonzero(np.frombuffer(pattern, dtype=bool))
        if len(columns):
            axes = (np.array(rows), height), (columns, width)
            tables = [torch.from_numpy(_nearest_on_axis(*axis, neighbors).T.astype(np.int32)) for axis in axes]
            products.append((tables[0].to(device), tables[1].to(device)))
    if not products:
        raise ValueError("mask: expected at least one known pixel, got none")
    return products


def products_of(mask: Tensor, neighbors: int) -> list[Product]:
    """Return the tables of a mask, cached between calls."""
    return _products(_key(mask), neighbors)


def _on_axis(table: Tensor, cell: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
    """Return the nearest positions on an axis and their squared distances relative to a common reference: (k, n)."""
    top = table.shape[1] - 1
    half = (2 * cell + torch.ceil(2 * part).long()).clamp(0, top)
    position = table.index_select(1, half)
    reference = cell.clamp(0, top // 2)
    step = (position - reference).to(part.dtype)
    # (p - q)^2 - (r - q)^2 without squaring large numbers; q = cell + part
    return position, step * (step + 2 * ((reference - cell).to(part.dtype) - part))


def _search(products: list[Product], neighbors: int, width: int, cell: Tensor, part: Tensor) -> Tensor:
    """Return flat indices (neighbors, n) of the known pixels nearest to cell + part, (2, n).

    They are exact, nearest first, in row-major order among equals. If too few exist, the nearest is repeated.
    """
    best: list[tuple[Tensor, Tensor]] = []
    for rows, columns in products:
        row, row_distance = _on_axis(rows, cell[1], part[1])
        column, column_distance = _on_axis(columns, cell[0], part[0])
        for i in range(len(row)):
            for j in range(min(len(column), neighbors // (i + 1))):
                before = (i + 1) * (j + 1) - 1  # pixels of this product that are at least as near
                _insert(best, row_distance[i] + column_distance[j], row[i] * width + column[j], before, neighbors)
    best += best[:1] * (neighbors - len(best))
    return torch.stack([index for _, index in best]).long()


def _insert(best: list[tuple[Tensor, Tensor]], distance: Tensor, index: Tensor, before: int, most: int) -> None:
    """Insert into the sorted list of the smallest (distance, index), not among the first ``before``."""
    for slot in range(before, len(best)):
        other, other_index = best[slot]
        closer = (distance < other) | ((distance == other) & (index < other_index))
        best[slot] = torch.where(closer, distance, other), torch.where(closer, index, other_index)
        if slot + 1 < most:
            distance, index = torch.where(closer, other, distance), torch.where(closer, other_index, index)
    if len(best) < most:
        best.append((distance, index))


def search_and_weigh(
    products: list[Product], neighbors: int, width: int, cell: Tensor, part: Tensor
) -> tuple[Tensor, Tensor]:
    """Return indices of the known pixels nearest to cell + part, (2, n), and their weights; both (neighbors, n).

    Weights are inverse to the distance, and add up to 1.
    """
    index = _search(products, neighbors, width, cell, part)
    row = index // width
    dx = (index - row * width - cell[0]).to(part.dtype) - part[0]
    dy = (row - cell[1]).to(part.dtype) - part[1]
    distance = (dx * dx + dy * dy).sqrt()
    # 1 / d relative to the nearest: no overflow near a known pixel; on it the other weights are 0
    weight = torch.where(index[1:] == index[0], 0, distance[0] / distance[1:])
    weight = torch.cat([torch.ones_like(distance[:1]), weight])
    return index, weight / weight.sum(dim=0)


def _nearest_known(flow: Tensor, mask: Tensor, neighbors: int) -> tuple[Tensor, Tensor]:
    """Compute :func:`idw_neighbors` for float32 or float64 flow that is finite and below 2^30."""
    count, _, height, width = flow.shape
    products = products_of(mask, neighbors)
    # double, so that the choice of neighbours does not depend on rounding
    double = torch.float32 if flow.device.type == "mps" else torch.float64
    plane = height * width
    flat = flow.movedim(1, 0).reshape(2, -1)
    index = flow.new_empty(neighbors, count * plane, dtype=torch.int64)
    weight = flow.new_empty(neighbors, count * plane)
    size = _CHUNK if flow.device.type == "cpu" else 128 * _CHUNK  # on a GPU fewer launches matter more than the cache
    for begin in range(0, count * plane, size):
        moved = flat[:, begin : begin + size].to(double)
        whole = moved.round()
        pixel = torch.arange(begin, begin + moved.shape[1], device=flow.device) % plane
        cell, part = torch.stack([pixel % width, pixel // width]) + whole.long(), moved - whole
        chunk = slice(begin, begin + size)
        index[:, chunk], weight[:, chunk] = search_and_weigh(products, neighbors, width, cell, part)
    shape = neighbors, count, plane
    return index.reshape(shape).movedim(0, 1).contiguous(), weight.reshape(shape).movedim(0, 1).contiguous()


def _fake(flow: Tensor, mask: Tensor, neighbors: int) -> tuple[Tensor, Tensor]:
    shape = flow.shape[0], neighbors, flow.shape[2] * flow.shape[3]
    return flow.new_empty(shape, dtype=torch.int64), flow.new_empty(shape)


nearest_known = custom_operator("nearest_known", _nearest_known, _fake)


@register_kernel(nearest_known, "cpu")
def _(flow: Tensor, mask: Tensor, neighbors: int) -> tuple[Tensor, Tensor]:
    loops = import_loops("spikekit.kernels.cpu_search")
    if loops is None:
        return _nearest_known(flow, mask, neighbors)
    return loops.nearest_known(flow, products_of(mask, neighbors), neighbors)


@register_kernel(nearest_known, "cuda")
def _(flow: Tensor, mask: Tensor, neighbors: int) -> tuple[Tensor, Tensor]:
    index, weight = gpu_kernel("nearest_known")(flow, products_of(mask, neighbors), neighbors)
    return index, weight.to(flow.dtype)


register_vmap(nearest_known, 1)


class NearestKnown(torch.autograd.Function):
    """:func:`nearest_known`, with weights differentiable in the flow."""

    generate_vmap_rule = True

    @staticmethod
    def forward(flow: Tensor, mask: Tensor, neighbors: int) -> tuple[Tensor, Tensor]:  # noqa: D102
        return nearest_known(flow, mask, neighbors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:  # noqa: D102
        index, weight = output
        ctx.mark_non_differentiable(index)
        ctx.save_for_backward(inputs[0], index, weight)

    @staticmethod
    def backward(ctx: Any, _: Tensor, grad: Tensor) -> tuple[Tensor, None, None]:  # noqa: D102
        flow, index, weight = ctx.saved_tensors
        _, _, height, width = flow.shape
        whole = flow.detach().round()
        part = (flow - whole).flatten(2)
        pixel = torch.arange(height * width, device=flow.device)
        row = index // width
        cell_x, cell_y = (whole.long().flatten(2) + torch.stack([pixel % width, pixel // width])).split(1, dim=1)
        dx = (index - row * width - cell_x).to(flow.dtype) - part[:, :1]
        dy = (row - cell_y).to(flow.dtype) - part[:, 1:]
        square = dx * dx + dy * dy
        # sum over i of w_i (g_i - mean g) (p_i - q) / d_i^2; without cancellation for the nearest, whose d may be tiny
        first, others = weight.split([1, weight.shape[1] - 1], dim=1)
        near = first * (others * (grad[:, :1] - grad[:, 1:])).sum(dim=1, keepdim=True)
        far = others * (grad[:, 1:] - (weight * grad).sum(dim=1, keepdim=True))
        factor = torch.cat([near, far], dim=1) / torch.where(square < torch.finfo(flow.dtype).tiny, 1, square)
        moved = torch.stack([(factor * dx).sum(dim=1), (factor * dy).sum(dim=1)], dim=1)
        return moved.reshape(flow.shape), None, None


def idw_neighbors(flow: Tensor, mask: Tensor, neighbors: int = 4) -> tuple[Tensor, Tensor]:
    """Return the known pixels nearest to the positions of a flow (N, 2, H, W), and their inverse-distance weights.

    A pixel is known where the mask (H, W) is not 0. Flat indices, int64, and weights, in the dtype of the flow but at
    least float32, are both (N, K, H W). The weights are differentiable in the flow. If fewer pixels are known, the
    nearest is repeated with weight 0.
    """
    flow = finite(flow.to(torch.promote_types(flow.dtype, torch.float32)))
    return NearestKnown.apply(flow, mask, neighbors)
