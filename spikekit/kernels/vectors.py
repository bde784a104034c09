"""Sums of products in vector registers, which Numba does not use for loops as short as a few temporal pixels.

All arrays are flat and contiguous: values, weights and sums float32, jumps int32. The literals ``lanes`` and ``others``
are the numbers of features and of weights that an index k stands for. One of the two is n, the other is 1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

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
def sum_products(code: _Vectors) -> None:
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
def add_products(code: _Vectors) -> None:
    """Do the transpose of :func:`sum_products`: add products of ``values[at : at + n]`` to ``out[to + jump[k] :]``."""
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
