"""Warping on a GPU: the search for the nearest known pixels, and the weighted gather with its two derivatives.

A program processes a block of positions, or a tile of channels and positions.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from spikekit.check import wide_dtype
from spikekit.kernels.gpu_parts import launch, my_pixels, store
from spikekit.kernels.layout import empty_like_layout, is_channels_last

_BLOCK = 128  # positions per program of the search, one per thread
_TILE = 1024  # elements per program of the gather
_CHANNELS = 8  # channels per tile
_CHANNELS_LAST = 64  # channels per tile in channels-last layout


@triton.jit
def _split(flow, pixel):
    """Return the whole position nearest to pixel + flow, and the remainder, both exact for any size.

    Adding 1.5 * 2^52 rounds half to even.
    """
    whole = (flow.to(tl.float64) + 6755399441055744.0) - 6755399441055744.0
    return pixel + whole.to(tl.int64), flow.to(tl.float64) - whole


@triton.jit
def _on_axis(table, length, cell, part, inside):
    """Look up the position for cell + part, -1 for none, and its squared distance relative to a common reference.

    (p - q)^2 - (r - q)^2 without squaring large numbers; q = cell + part, and r is the cell clamped to the axis.
    """
    half = 2 * cell + tl.ceil(2 * part).to(tl.int64)
    half = tl.minimum(tl.maximum(half, 0), 2 * length - 1)
    position = tl.load(table + half, mask=inside, other=-1)
    reference = tl.minimum(tl.maximum(cell, 0), length - 1)
    step = (position - reference).to(tl.float64)
    return position, step * (step + 2 * ((reference - cell).to(tl.float64) - part))


@triton.jit
def _distance(index, width, x, x_part, y, y_part):
    """Return the distance of a pixel from (x + x_part, y + y_part)."""
    row = index // width
    dx = (index - row * width - x).to(tl.float64) - x_part
    dy = (row - y).to(tl.float64) - y_part
    return tl.sqrt(dx * dx + dy * dy)


@triton.jit(do_not_specialize=["height", "width", "products", "on_rows", "on_columns", "neighbors"])
def _search_kernel(
    flow, rows, columns, index, height, width, products, on_rows, on_columns, neighbors, block: tl.constexpr
):
    """Find the nearest known pixels of a block of positions, one by one; repeat the first if too few exist.

    The next pixel is the first one after the last, by distance and then by index, among the candidates: pairs of the
    i-th nearest row and the j-th nearest column of a product with i j <= ``neighbors``. All other pairs are further
    away. The flow is read once and the index written once; the tables stay in the cache.
    """
    plane = tl.cast(height, tl.int64) * width
    b, pixel, inside = my_pixels(plane, block)
    x, x_part = _split(tl.load(flow + 2 * b * plane + pixel, mask=inside, other=0), pixel % width)
    y, y_part = _split(tl.load(flow + (2 * b + 1) * plane + pixel, mask=inside, other=0), pixel // width)
    index += b * neighbors * plane + pixel
    nearest = tl.full([block], -1, tl.int64)
    last = nearest
    last_distance = tl.full([block], float("-inf"), tl.float64)
    for slot in range(neighbors):
        best = tl.full([block], -1, tl.int64)
        best_distance = tl.full([block], float("inf"), tl.float64)
        for i in range(products * on_rows):
            row, row_distance = _on_axis(rows + i * 2 * height, height, y, y_part, inside)
            of_product = i // on_rows * on_columns
            for j in range(of_product, of_product + tl.minimum(on_columns, neighbors // (i % on_rows + 1))):
                column, column_distance = _on_axis(columns + j * 2 * width, width, x, x_part, inside)
                distance = row_distance + column_distance
                candidate = row.to(tl.int64) * width + column
                ahead = (distance > last_distance) | ((distance == last_distance) & (candidate > last))
                first = (distance < best_distance) | ((distance == best_distance) & (candidate < best))
                closer = (row >= 0) & (column >= 0) & ahead & first
                best = tl.where(closer, candidate, best)
                best_distance = tl.where(closer, distance, best_distance)
        nearest = tl.where(nearest < 0, best, nearest)
        last, last_distance = best, best_distance
        tl.store(index + slot * plane, tl.where(best < 0, nearest, best), mask=inside)


@triton.jit
def _ratio(pixel, nearest, shortest, width, x, x_part, y, y_part):
    """Return the inverse distance relative to that of the nearest pixel: no overflow, and 0 if that distance is 0."""
    distance = _distance(pixel, width, x, x_part, y, y_part)
    again = pixel == nearest
    return tl.where(again, 0.0, shortest / tl.where(again, 1.0, distance))


@triton.jit(do_not_specialize=["height", "width", "neighbors"])
def _weigh_kernel(flow, index, weight, height, width, neighbors, block: tl.constexpr):
    """Compute the weights of the neighbours of a block of positions; read the index twice, write the weight once."""
    plane = tl.cast(height, tl.int64) * width
    b, pixel, inside = my_pixels(plane, block)
    x, x_part = _split(tl.load(flow + 2 * b * plane + pixel, mask=inside, other=0), pixel % width)
    y, y_part = _split(tl.load(flow + (2 * b + 1) * plane + pixel, mask=inside, other=0), pixel // width)
    index += b * neighbors * plane + pixel
    weight += b * neighbors * plane + pixel
    nearest = tl.load(index, mask=inside, other=0)
    shortest = _distance(nearest, width, x, x_part, y, y_part)
    total = tl.zeros([block], tl.float64) + 1
    for k in range(1, neighbors):
        pixel_k = tl.load(index + k * plane, mask=inside, other=0)
        total += _ratio(pixel_k, nearest, shortest, width, x, x_part, y, y_part)
    store(weight, 1 / total, inside)
    for k in range(1, neighbors):
        pixel_k = tl.load(index + k * plane, mask=inside, other=0)
        store(weight + k * plane, _ratio(pixel_k, nearest, shortest, width, x, x_part, y, y_part) / total, inside)


def nearest_known(flow: Tensor, products: list[tuple[Tensor, Tensor]], neighbors: int) -> tuple[Tensor, Tensor]:
    """Search exactly, in float64, like the operator of the same name.

    ``products`` holds tables of rows and columns, int32, (at most ``neighbors``, 2 H) and (at most ``neighbors``, 2 W):
    the nearest known positions of every half pixel on the axis.
    """
    rows, columns = (pad_sequence(list(axis), True, -1).contiguous() for axis in zip(*products, strict=True))
    batch, _, height, width = flow.shape
    index = flow.new_empty(batch, neighbors, height * width, dtype=torch.int64)
    weight = flow.new_empty(index.shape)
    programs = batch * triton.cdiv(height * width, _BLOCK)
    sizes = height, width, len(products), rows.shape[1], columns.shape[1], neighbors
    flow = flow.detach().contiguous()
    launch(_search_kernel, programs, flow, rows, columns, index, *sizes, block=_BLOCK)
    launch(_weigh_kernel, programs, flow, index, weight, height, width, neighbors, block=_BLOCK)
    return index, weight


@triton.jit
def _my_tile(channels, points, tile_c: tl.constexpr, tile_q: tl.constexpr):
    """Return picture, channels (a column) and points (a row) of this program; channels vary fastest."""
    program = tl.program_id(0)
    blocks = tl.cdiv(channels, tile_c)
    c = (program % blocks).to(tl.int64) * tile_c + tl.arange(0, tile_c)[:, None]
    program = program // blocks
    blocks = tl.cdiv(points, tile_q)
    q = (program % blocks).to(tl.int64) * tile_q + tl.arange(0, tile_q)[None, :]
    return (program // blocks).to(tl.int64), c, q


@triton.jit(do_not_specialize=["neighbors"])
def _gather_kernel(
    values, index, weight, result, channels, points, neighbors,
    values_b, values_c, values_p, result_b, result_c, result_q,
    wide: tl.constexpr, tile_c: tl.constexpr, tile_q: tl.constexpr, back: tl.constexpr,
):  # fmt: skip
    """Sum the weighted neighbours of a tile of results, or with ``back`` add the tile to its neighbours, atomically."""
    b, c, q = _my_tile(channels, points, tile_c, tile_q)
    inside = (c < channels) & (q < points)
    values += b * values_b + c * values_c
    result += b * result_b + c * result_c + q * result_q
    total = tl.load(result, mask=inside, other=0).to(wide) if back else tl.zeros([tile_c, tile_q], wide)
    for k in range(neighbors):
        entry = (b * neighbors + k) * points + q
        pixel = tl.load(index + entry, mask=q < points, other=0)
        share = tl.load(weight + entry, mask=q < points, other=0).to(wide)
        if back:
            tl.atomic_add(values + pixel * values_p, total * share, mask=inside, sem="relaxed")
        else:
            total += tl.load(values + pixel * values_p, mask=inside, other=0).to(wide) * share
    if not back:
        store(result, total, inside)


@triton.jit(do_not_specialize=["neighbors"])
def _dot_kernel(
    values, grad, index, result, channels, points, neighbors,
    values_b, values_c, values_p, grad_b, grad_c, grad_q,
    wide: tl.constexpr, tile_c: tl.constexpr, tile_q: tl.constexpr,
):  # fmt: skip
    """Compute the dot product over the channels for a block of points and one neighbour."""
    b, k, q = _my_tile(neighbors, points, 1, tile_q)
    entry = (b * neighbors + k) * points + q
    pixel = tl.load(index + entry, mask=q < points, other=0)
    values += b * values_b + pixel * values_p
    grad += b * grad_b + q * grad_q
    total = tl.zeros([tile_c, tile_q], wide)
    for begin in range(0, channels, tile_c):
        c = tl.cast(begin, tl.int64) + tl.arange(0, tile_c)[:, None]
        inside = (c < channels) & (q < points)
        value = tl.load(values + c * values_c, mask=inside, other=0).to(wide)
        total += value * tl.load(grad + c * grad_c, mask=inside, other=0).to(wide)
    store(result + entry, tl.sum(total, axis=0)[None, :], q < points)


def _tile(values: Tensor, dtype: torch.dtype) -> dict[str, int | tl.dtype]:
    """Return the tile of a program, channels by points, and the dtype of its sums."""
    most = _CHANNELS_LAST if is_channels_last(values) else _CHANNELS
    channels = min(most, triton.next_power_of_2(values.shape[1]))
    wide = tl.float64 if dtype is torch.float64 else tl.float32
    return {"tile_c": channels, "tile_q": _TILE // channels, "wide": wide}


def _tiles(batch: int, channels: int, points: int, tile: dict[str, int | tl.dtype]) -> int:
    return batch * triton.cdiv(channels, tile["tile_c"]) * triton.cdiv(points, tile["tile_q"])


def weighted_gather(values: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Read every neighbour of every point once, write the sums once."""
    result = empty_like_layout(values, index.shape[2])
    _gather(values, index, weight, result, _tile(values, wide_dtype(values, weight)), False)
    return result


def _gather(
    values: Tensor, index: Tensor, weight: Tensor, result: Tensor, tile: dict[str, int | tl.dtype], back: bool
) -> None:
    values, index, weight, result = values.detach(), index.contiguous(), weight.detach().contiguous(), result.detach()
    (batch, channels, points), neighbors = result.shape, index.shape[1]
    sizes = channels, points, neighbors, *values.stride(), *result.stride()
    programs = _tiles(batch, channels, points, tile)
    launch(_gather_kernel, programs, values, index, weight, result, *sizes, **tile, back=back)


def weighted_scatter(grad: Tensor, index: Tensor, weight: Tensor, size: int) -> Tensor:
    """Read the gradient once and add it to every neighbour; not deterministic."""
    if torch.are_deterministic_algorithms_enabled():
        return NotImplemented
    dtype = wide_dtype(grad, weight)
    result = empty_like_layout(grad, size).to(dtype).zero_()
    _gather(result, index, weight, grad, _tile(grad, dtype), True)
    return result.to(grad.dtype)


def weighted_dot(values: Tensor, grad: Tensor, index: Tensor) -> Tensor:
    """Read every neighbour of every point, and the gradient as often, and write the sums once."""
    values, grad, index = values.detach(), grad.detach(), index.contiguous()
    (batch, channels, _), (_, neighbors, points) = values.shape, index.shape
    result = values.new_empty(index.shape, dtype=wide_dtype(values, grad))
    tile = _tile(values, result.dtype)
    sizes = channels, points, neighbors, *values.stride(), *grad.stride()
    programs = batch * neighbors * triton.cdiv(points, tile["tile_q"])
    launch(_dot_kernel, programs, values, grad, index, result, *sizes, **tile)
    return result
