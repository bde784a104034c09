"""Sums in vector registers, which Numba does not find in loops as short as a few temporal pixels."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

_LONG = ir.IntType(64)


@intrinsic(prefer_literal=True)
def sum_products(
    typing: Any, values: Any, lanes: Any, weights: Any, others: Any, jump: Any, first: Any, last: Any, at: Any,
    out: Any, to: Any,
) -> Any:  # fmt: skip
    """Compute ``out[to : to + n] = sum(values[at + jump[k] :] * weights[k * others :] for k in range(first, last))``.

    Here n is the larger one of the literals ``lanes`` and ``others``, the numbers of values and of weights that each k
    reads; the other one is 1. All arrays are flat and contiguous, ``values`` and ``weights`` float32, ``jump`` int32.
    ``out`` is float32, or uint16 for bfloat16, rounded to even.
    """
    count = max(lanes.literal_value, others.literal_value)
    vector, words = ir.VectorType(ir.FloatType(), count), ir.VectorType(ir.IntType(32), count)

    def same(number: int) -> ir.Constant:
        return ir.Constant(words, [number] * count)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def data(n: int) -> Any:
            return context.make_array(signature.args[n])(context, builder, arguments[n]).data

        def read(array: Any, index: Any, size: int) -> Any:
            place = builder.gep(array, [index])
            if size == count:
                return builder.load(builder.bitcast(place, vector.as_pointer()), align=4)
            alone = builder.insert_element(ir.Constant(vector, ir.Undefined), builder.load(place), ir.IntType(32)(0))
            return builder.shuffle_vector(alone, alone, same(0))

        array, factors, jumps, result = (data(n) for n in (0, 2, 4, 8))
        begin, end, start, target = (arguments[n] for n in (5, 6, 7, 9))
        total = cgutils.alloca_once_value(builder, ir.Constant(vector, [0.0] * count))
        with cgutils.for_range_slice(builder, begin, end, _LONG(1)) as (k, _):
            index = builder.add(start, builder.sext(builder.load(builder.gep(jumps, [k])), _LONG))
            value = read(array, index, lanes.literal_value)
            weight = read(factors, builder.mul(k, _LONG(others.literal_value)), others.literal_value)
            product = builder.fmul(value, weight, flags=("contract",))
            builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
        found = builder.load(total)
        if out.dtype == types.uint16:
            word = builder.bitcast(found, words)
            even = builder.and_(builder.lshr(word, same(16)), same(1))
            found = builder.lshr(builder.add(builder.add(word, same(0x7FFF)), even), same(16))
            found = builder.trunc(found, ir.VectorType(ir.IntType(16), count))
        place = builder.bitcast(builder.gep(result, [target]), found.type.as_pointer())
        builder.store(found, place, align=out.dtype.bitwidth // 8)
        return context.get_dummy_value()

    whole = types.int64
    return types.void(values, lanes, weights, others, jump, whole, whole, whole, out, whole), generate
