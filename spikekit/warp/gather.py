"""Weighted sums of gathered pixels: three bilinear operators, each the derivative of the other two.

    gather   out[b, c, q] = sum_k weight[b, k, q] values[b, c, index[b, k, q]]
    scatter  out[b, c, p] = sum of weight[b, k, q] grad[b, c, q] over all k, q with index[b, k, q] = p
    dot      out[b, k, q] = sum_c values[b, c, index[b, k, q]] grad[b, c, q]

They make warps differentiable to any order. Sums are computed in float32 or wider. The memory layout follows ``values``
(``grad`` for scatter): channels last stays channels last.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from spikekit.check import wide_dtype
from spikekit.kernels import cpu_warp, custom_operator, gpu_kernel, register_kernel, register_vmap
from spikekit.kernels.layout import empty_like_layout, is_channels_last

_FEW = 8  # channels; with fewer, a CPU is faster plane by plane


def _gather(values: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Map (B, C, P), (B, K, Q) and (B, K, Q) to (B, C, Q), in the dtype of ``values``."""
    total = values.new_zeros(*values.shape[:2], index.shape[2], dtype=wide_dtype(values, weight))
    for index_k, weight_k in zip(index.split(1, dim=1), weight.split(1, dim=1), strict=True):
        total += values.gather(2, index_k.expand(-1, values.shape[1], -1)) * weight_k
    return empty_like_layout(values, index.shape[2]).copy_(total)


def _scatter(grad: Tensor, index: Tensor, weight: Tensor, size: int) -> Tensor:
    """Map (B, C, Q), (B, K, Q) and (B, K, Q) to (B, C, size), in the dtype of ``grad``."""
    dtype = wide_dtype(grad, weight)
    total = grad.new_zeros(*grad.shape[:2], size, dtype=dtype)
    for index_k, weight_k in zip(index.split(1, dim=1), weight.split(1, dim=1), strict=True):
        total.scatter_add_(2, index_k.expand(-1, grad.shape[1], -1), (grad * weight_k).to(dtype))
    return empty_like_layout(grad, size).copy_(total)


def _dot(values: Tensor, grad: Tensor, index: Tensor) -> Tensor:
    """Map (B, C, P), (B, C, Q) and (B, K, Q) to (B, K, Q), in float32 or wider."""
    dtype = wide_dtype(values, grad)
    result = values.new_empty(index.shape, dtype=dtype)
    for k, index_k in enumerate(index.split(1, dim=1)):
        gathered = values.gather(2, index_k.expand(-1, values.shape[1], -1))
        result[:, k] = (gathered.to(dtype) * grad).sum(dim=1)
    return result


def _operator(plain: Callable[..., Tensor], fake: Callable[..., Tensor]) -> Any:
    name = f"weighted{plain.__name__}"
    op = custom_operator(name, plain, fake)
    rows = getattr(cpu_warp, name)

    @register_kernel(op, "cpu")
    def _(first: Tensor, *others: Any) -> Tensor:
        return (rows if is_channels_last(first) or first.shape[1] >= _FEW else plain)(first, *others)

    @register_kernel(op, "cuda")
    def _(*args: Any) -> Tensor:
        result = gpu_kernel(name)(*args)
        return plain(*args) if result is NotImplemented else result

    register_vmap(op, 3)
    return op


weighted_gather = _operator(_gather, lambda values, index, weight: empty_like_layout(values, index.shape[2]))
weighted_scatter = _operator(_scatter, lambda grad, index, weight, size: empty_like_layout(grad, size))
weighted_dot = _operator(
    _dot, lambda values, grad, index: values.new_empty(index.shape, dtype=wide_dtype(values, grad))
)


class _Weighted(torch.autograd.Function):
    """Base of the three operators, whose derivatives depend on the first three arguments."""

    generate_vmap_rule = True

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:3])


class Gather(_Weighted):
    """:func:`weighted_gather`, differentiable in values and weight."""

    @staticmethod
    def forward(values: Tensor, index: Tensor, weight: Tensor) -> Tensor:  # noqa: D102
        return weighted_gather(values, index, weight)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, Tensor | None]:  # noqa: D102
        values, index, weight = ctx.saved_tensors
        of_values, _, of_weight = ctx.needs_input_grad
        return (
            Scatter.apply(grad, index, weight, values.shape[2]) if of_values else None,
            None,
            Dot.apply(values, grad, index).to(weight.dtype) if of_weight else None,
        )


class Scatter(_Weighted):
    """:func:`weighted_scatter`, differentiable in grad and weight."""

    @staticmethod
    def forward(grad: Tensor, index: Tensor, weight: Tensor, size: int) -> Tensor:  # noqa: D102
        return weighted_scatter(grad, index, weight, size)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, Tensor | None, None]:  # noqa: D102
        other, index, weight = ctx.saved_tensors
        of_other, _, of_weight, _ = ctx.needs_input_grad
        return (
            Gather.apply(grad, index, weight) if of_other else None,
            None,
            Dot.apply(grad, other, index).to(weight.dtype) if of_weight else None,
            None,
        )


class Dot(_Weighted):
    """:func:`weighted_dot`, differentiable in values and grad."""

    @staticmethod
    def forward(values: Tensor, grad: Tensor, index: Tensor) -> Tensor:  # noqa: D102
        return weighted_dot(values, grad, index)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # noqa: D102
        values, other, index = ctx.saved_tensors
        of_values, of_other, _ = ctx.needs_input_grad
        return (
            Scatter.apply(other, index, grad, values.shape[2]).to(values.dtype) if of_values else None,
            Gather.apply(values, index, grad).to(other.dtype) if of_other else None,
            None,
        )
