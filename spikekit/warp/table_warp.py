"""A warp by a table of positions in one go, see :func:`spikekit.flow_warp_idw`; and its transpose.

The result is that of :func:`weighted_gather` with what :func:`nearest_known` finds. Where a loop over positions can be
compiled, no index and no weight has to be kept, neither on the way nor for the derivative.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from spikekit.kernels import custom_operator, loops, register_kernel
from spikekit.kernels.layout import empty_like_layout, is_channels_last
from spikekit.warp.gather import Dot, fold_into_batch, weighted_gather, weighted_scatter
from spikekit.warp.neighbors import NearestKnown, finite, nearest_known, table_of

_MANY = 32  # channels: of so many, rows are gathered faster than planes


def in_one_go(values: Tensor) -> bool:
    """Whether a loop can be compiled for (N, C, H W), and is worth it: for few planes on a CPU, by Numba."""
    return loops.NUMBA and values.device.type == "cpu" and values.shape[1] < _MANY


def _warp(values: Tensor, flow: Tensor, mask: Tensor, neighbors: int, steps: int) -> Tensor:
    """(N, C, H W), (N, 2, H, W), float32 or float64, and (H, W) to (N, C, H W)."""
    return weighted_gather(values, *nearest_known(finite(flow), mask, neighbors, steps))


def _unwarp(grad: Tensor, flow: Tensor, mask: Tensor, neighbors: int, steps: int) -> Tensor:
    """The transpose in the values, of the same shapes."""
    return weighted_scatter(grad, *nearest_known(finite(flow), mask, neighbors, steps), grad.shape[2])


def _operator(plain: Any, name: str) -> Any:
    op = custom_operator(f"table_{name}", plain, lambda values, *_: empty_like_layout(values, values.shape[2]))
    fold_into_batch(op, 2)

    @register_kernel(op, "cpu")
    def _(values: Tensor, flow: Tensor, mask: Tensor, neighbors: int, steps: int) -> Tensor:
        compiled = None if is_channels_last(values) else loops.import_loops("spikekit.kernels.cpu_table")
        if compiled is None:
            return plain(values, flow, mask, neighbors, steps)
        return getattr(compiled, name)(values, flow, table_of(mask, neighbors, steps, flow.dtype)).to(values.dtype)

    return op


table_warp = _operator(_warp, "warp")
table_unwarp = _operator(_unwarp, "unwarp")


class _Linear(torch.autograd.Function):
    """One of the two operators: linear in its first argument, by which the other one differentiates it."""

    generate_vmap_rule = True

    @staticmethod
    def forward(values: Tensor, flow: Tensor, mask: Tensor, neighbors: int, steps: int, transposed: bool) -> Tensor:
        return (table_unwarp if transposed else table_warp)(values, flow, mask, neighbors, steps)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        values, flow, mask, *ctx.choices = inputs
        ctx.save_for_backward(values, flow, mask)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        values, flow, mask = ctx.saved_tensors
        neighbors, steps, transposed = ctx.choices
        of_values, of_flow, *_ = ctx.needs_input_grad
        found = None
        if of_flow:
            near = finite(flow)
            index, weight = NearestKnown.apply(near, mask, neighbors, steps)
            dot = Dot.apply(*(grad, values) if transposed else (values, grad), index)
            found = NearestKnown.of_flow(near, index, weight, dot.to(weight.dtype), steps) * (near == flow)
        of_values = _Linear.apply(grad, flow, mask, neighbors, steps, not transposed) if of_values else None
        return of_values, found, *[None] * 4


def warp_by_table(values: Tensor, flow: Tensor, mask: Tensor, neighbors: int, steps: int) -> Tensor:
    """(N, C, H W) where flow (N, 2, H, W), of float32 or wider, points to; differentiable in both."""
    return _Linear.apply(values, flow, mask, neighbors, steps, False)
