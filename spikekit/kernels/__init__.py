"""Fast kernels of the heavy operators for CPU and GPU; the plain torch path is with the operator."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from spikekit.kernels import cpu


def operator(fake: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Make a custom operator of the decorated function, with any number of leading dimensions.

    It is called as the function, less the underscore, and is run by the functions of that name in
    :mod:`spikekit.kernels.cpu` and :mod:`spikekit.kernels.gpu` where there are such.

    Args:
        fake: given the arguments, returns empty tensors of the sizes and types of the results.
    """

    def make(plain: Callable[..., Any]) -> Any:
        name = plain.__name__.removeprefix("_")
        op = torch.library.custom_op(f"spikekit::{name}", plain, mutates_args=())
        op.register_fake(fake)
        if hasattr(cpu, name):
            op.register_kernel("cpu")(getattr(cpu, name))
            register_on_gpu(op, lambda *args: gpu_kernel(name)(*args))
        batch_first(op)
        return op

    return make


def register_on_gpu(op: Any, kernel: Callable[..., Any]) -> None:
    """Run a custom operator by a Triton kernel, where Triton is installed; else its own torch path runs."""
    if find_spec("triton") is not None:
        op.register_kernel("cuda")(kernel)


def gpu_kernel(name: str) -> Callable[..., Any]:
    """Return a function of :mod:`spikekit.kernels.gpu`, which is imported when it is first needed."""
    return getattr(import_module("spikekit.kernels.gpu"), name)


def batch_first(op: Any) -> None:
    """Let ``torch.func.vmap`` give its axis to a custom operator as one more leading dimension of every tensor."""

    def rule(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        def with_axis(value: Any, dim: int | None) -> Any:
            if not isinstance(value, Tensor):
                return value
            return value.expand(info.batch_size, *value.shape) if dim is None else value.movedim(dim, 0)

        result = op(*map(with_axis, args, in_dims))
        return result, (0,) * len(result) if isinstance(result, tuple) else 0

    op.register_vmap(rule)
