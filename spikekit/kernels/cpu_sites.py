"""Site-wise search on a CPU, see :mod:`spikekit.warp.site_search`, compiled by Numba."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from torch import Tensor

from spikekit.kernels.compiled import compiled, in_threads
from spikekit.kernels.layout import new_tensor

_ROWS = 16  # sensor rows per job

# Sums of products in vector registers, which Numba does not use for loops as short as a few temporal pixels. All arrays
# are flat and contiguous: values, weights and sums float32, jumps int32. The literals ``lanes`` and ``others`` are the
# numbers of features and of weights that an index k stands for. One of the two is n, the other is 1.
_LONG, _WORD, _REAL = ir.IntType(64), ir.IntType(32), ir.FloatType()
_FUSED = ("contract",)  # may be fused to a multiply-add


class _Vectors:
    """Code for vectors of ``count`` numbers."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.builder, self.arguments, self.types = builder, arguments, signature.args
        self.lanes, self.others = (signature.args[n].literal_value for n in (1, 3))
        self.count = max(self.lanes, self.others)
        self.vector = ir.VectorType(_REAL, self.count)
        self.data = {n: context.make_array(self.types[n])(context, builder, arguments[n]).data for n in (0, 2, 4, 8)}

    def same(self, number: int) -> ir.Constant:
        return ir.Constant(ir.VectorType(_WORD, self.count), [number] * self.count)

    def place(self, array: int, index: Any, kind: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(self.data[array], [index]), kind.as_pointer())

    def read(self, array: int, index: Any, size: int) -> Any:
        """Load ``count`` numbers, or one into all lanes."""
        if size == self.count:
            return self.builder.load(self.place(array, index, self.vector), align=4)
        one = self.builder.load(self.place(array, index, _REAL))
        alone = self.builder.insert_element(self.vector(ir.Undefined), one, _WORD(0))
        return self.builder.shuffle_vector(alone, alone, self.same(0))

    def loop(self) -> Any:
        return cgutils.for_range_slice(self.builder, *self.arguments[5:7], _LONG(1))

    def jumped(self, start: Any, k: Any) -> Any:
        return self.builder.add(start, self.builder.sext(self.builder.load(self.place(4, k, _WORD)), _LONG))

    def weight(self, k: Any) -> Any:
        return self.read(2, self.builder.mul(k, _LONG(self.others)), self.others)


def _intrinsic(generate: Callable[[_Vectors], None]) -> Any:
    def typed(
        typing: Any, values: Any, lanes: Any, weights: Any, others: Any, jump: Any, first: Any, last: Any, at: Any,
        out: Any, to: Any,
    ) -> Any:  # fmt: skip
        def compile_vectors(*known: Any) -> Any:
            generate(_Vectors(*known))
            return known[0].get_dummy_value()

        return types.void(values, lanes, weights, others, jump, *[types.int64] * 3, out, types.int64), compile_vectors

    return intrinsic(prefer_literal=True)(typed)


@_intrinsic
def _sum_products(code: _Vectors) -> None:
    """Compute ``out[to : to + n] = sum(values[at + jump[k] :] * weights[k * others :] for k in range(first, last))``.

    ``out`` is float32, or uint16 for bfloat16, rounded to even.
    """
    builder, at, to = code.builder, code.arguments[7], code.arguments[9]
    total = cgutils.alloca_once_value(builder, ir.Constant(code.vector, [0.0] * code.count))
    with code.loop() as (k, _):
        product = builder.fmul(code.read(0, code.jumped(at, k), code.lanes), code.weight(k), flags=_FUSED)
        builder.store(builder.fadd(builder.load(total), product, flags=_FUSED), total)
    found, kind = builder.load(total), code.types[8].dtype
    if kind == types.uint16:
        word = builder.bitcast(found, code.same(0).type)
        even = builder.and_(builder.lshr(word, code.same(16)), code.same(1))
        found = builder.lshr(builder.add(builder.add(word, code.same(0x7FFF)), even), code.same(16))
        found = builder.trunc(found, ir.VectorType(ir.IntType(16), code.count))
    builder.store(found, code.place(8, to, found.type), align=kind.bitwidth // 8)


@_intrinsic
def _add_products(code: _Vectors) -> None:
    """Do the transpose of :func:`_sum_products`: add products of ``values[at : at + n]`` to ``out[to + jump[k] :]``."""
    builder, at, to = code.builder, code.arguments[7], code.arguments[9]
    value = code.read(0, at, code.count)
    with code.loop() as (k, _):
        product = builder.fmul(value, code.weight(k), flags=_FUSED)
        if code.lanes < code.count:  # the sum of the products
            kind = ir.FunctionType(_REAL, [_REAL, code.vector])
            add = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fadd.v{code.count}f32")
            product = builder.call(add, [_REAL(0.0), product], fastmath=("reassoc",))
        place = code.place(8, code.jumped(to, k), product.type)
        builder.store(builder.fadd(builder.load(place, align=4), product), place, align=4)


@compiled
def _to_steps(flow: Any, shares: Any, at: Any, length: Any, steps: Any, out: Any) -> None:
    """Write the moved sites of a row on an axis, in steps: flow (2, W), positions ``at`` (W), out (W)."""
    a, b, far = shares[0], shares[1], np.float32(2 * length)
    for x in range(len(out)):
        moved = min(max(a * flow[0, x] + b * flow[1, x], -far), far)
        to = np.int32(np.rint(moved * np.float32(steps))) + at[x] * steps
        out[x] = min(max(to, -steps), length * steps)


@compiled
def _placed(to: Any, length: Any, low: Any, high: Any, steps: Any) -> Any:
    """Return base, place and fraction of a moved site on an axis, see :meth:`SiteTable.classes`."""
    base = to // steps
    place = base & 1
    if base < -low:
        place = base + 3
    if base + high >= length:
        place = 3 - low + length - base
    return base, place, to - base * steps


@compiled
def _class(to_y: Any, to_x: Any, height: Any, width: Any, low: Any, high: Any, steps: Any) -> Any:
    """Return the base of a moved site, as an index, and its class."""
    row, i, down = _placed(to_y, height, low, high, steps)
    column, j, right = _placed(to_x, width, low, high, steps)
    base, coarse = row * width + column, steps // 2
    if i < 2 and j < 2:
        return base, ((2 * i + j) * steps + down) * steps + right
    border = ((i * (4 - low + high) + j) * coarse + down // 2) * coarse + right // 2
    return base, 4 * steps * steps + border


@lru_cache
def _loop(spread: bool, channels: int, pixels: int, steps: int) -> Any:
    """Compile the loop over sites for F = ``channels`` and s^2 = ``pixels``, or that of the derivative, ``spread``."""
    lanes, calls = (1, channels) if pixels > 1 else (channels, 1)

    def loop(
        values: Any, flow: Any, shares: Any, start: Any, jump: Any, weight: Any, low: Any, high: Any, rows: Any,
        times: Any, out: Any,
    ) -> None:  # fmt: skip
        """Map features (T, H, W, F) to temporal pixels (H, W, T, F, s^2), or their gradients back, added to zeros.

        All arrays are contiguous; flow (2, 2, H, W), first and last of the rows of the sensor and of the time points.
        """
        height, width = flow.shape[2:]
        given, weights, results = values.ravel(), weight.ravel(), out.ravel()
        columns, to_y, to_x = np.arange(width), np.empty(width, np.int32), np.empty(width, np.int32)
        for y in range(rows[0], rows[1]):
            for t in range(times[0], times[1]):
                _to_steps(flow[:, 1, y], shares[t], np.full(width, y), height, steps, to_y)
                _to_steps(flow[:, 0, y], shares[t], columns, width, steps, to_x)
                for x in range(width):
                    base, which = _class(to_y[x], to_x[x], height, width, low, high, steps)
                    first, last = start[which], start[which + 1]
                    site = (t * height * width + base) * channels
                    pixel = ((y * width + x) * len(shares) + t) * channels * pixels
                    for c in range(calls):
                        one, other = site + c, pixel + c * pixels
                        if spread:
                            _add_products(given, lanes, weights, pixels, jump, first, last, other, results, one)
                        else:
                            _sum_products(given, lanes, weights, pixels, jump, first, last, one, results, other)

    return compiled(loop)


def search_sites(
    features: Tensor, flow: Tensor, shares: Tensor, start: Tensor, offset: Tensor, weight: Tensor,
    scale: int, low: int, high: int, most: int, steps: int,
) -> Tensor:  # fmt: skip
    """Map (B, T, F, H, W) to (B, T F s^2, H, W), float32 or bfloat16."""
    batch, times, channels, height, width = features.shape
    half = features.dtype is torch.bfloat16
    search = _loop(False, channels, scale**2, steps)
    out = new_tensor((batch, height, width, times, channels, scale**2), features.dtype)
    rows = features.permute(0, 1, 3, 4, 2).float().contiguous()
    jump = (offset[:, 0] * width + offset[:, 1]) * channels
    table = [part.numpy() for part in (shares.float(), start, jump, weight)]
    for features_b, flow_b, out_b in zip(rows.numpy(), flow.contiguous().numpy(), out, strict=True):
        result = (out_b.view(torch.uint16) if half else out_b).numpy()
        jobs = ((y, min(y + _ROWS, height)) for y in range(0, height, _ROWS))
        arguments = features_b, flow_b, *table, low, high
        in_threads(search, ((*arguments, job, (0, times), result) for job in jobs))
    return out.flatten(3).movedim(-1, 1)


def spread_sites(
    grad: Tensor, flow: Tensor, shares: Tensor, start: Tensor, offset: Tensor, weight: Tensor,
    scale: int, low: int, high: int, most: int, steps: int,
) -> Tensor:  # fmt: skip
    """Return its derivative in the features, (B, T F s^2, H, W) to (B, T, F, H, W), float32."""
    times = len(shares)
    rows = grad.movedim(1, -1).float().contiguous().unflatten(-1, (times, -1, scale**2))
    batch, height, width, _, channels, _ = rows.shape
    spread = _loop(True, channels, scale**2, steps)
    out = new_tensor((batch, times, height, width, channels), torch.float32, np.zeros)
    jump = (offset[:, 0] * width + offset[:, 1]) * channels
    table = [part.numpy() for part in (shares.float(), start, jump, weight)]
    for rows_b, flow_b, out_b in zip(rows.numpy(), flow.contiguous().numpy(), out.numpy(), strict=True):
        arguments = rows_b, flow_b, *table, low, high
        in_threads(spread, ((*arguments, (0, height), (t, t + 1), out_b) for t in range(times)))
    return out.permute(0, 1, 4, 2, 3)
