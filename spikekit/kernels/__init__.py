"""Fast kernels of the heavy operators for CPU and GPU; the plain torch path is with the operator."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

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
        op = custom_operator(name, plain, fake)
        if hasattr(cpu, name):
            register_kernel(op, "cpu")(getattr(cpu, name))
            register_on_gpu(op, lambda *args: gpu_kernel(name)(*args))
        batch_first(op)
        return op

    return make


def custom_operator(name: str, plain: Callable[..., Any], fake: Callable[..., Any]) -> Any:
    """Make the custom operator ``spikekit::name``, which ``plain`` runs where no kernel is registered."""
    op = torch.library.custom_op(f"spikekit::{name}", plain, mutates_args=(), device_types=())
    op.register_fake(fake)
    register_kernel(op, "default")(plain)
    return op


def register_kernel(op: Any, device: str) -> Callable[[Callable[..., Any]], None]:
    """Run a custom operator by the decorated function on a type of device.

    The operator's own ``register_kernel`` would import the compiler at the first call, which takes a second or two. It
    also looks, at every call, whether a result shares memory with an argument, which must not be; here a test does.
    """
    return lambda kernel: torch.library.impl(f"spikekit::{op._name}", device, compiler_kept_out(kernel))


def compiler_kept_out(function: Callable[..., Any]) -> Callable[..., Any]:
    """As ``torch.compiler.disable``, which imports the compiler even for those who compile nothing."""
    disabled = torch._disable_dynamo(function)  # imports it when it is called

    @wraps(function)
    def run(*args: Any, **options: Any) -> Any:
        return (disabled if "torch._dynamo" in sys.modules else function)(*args, **options)

    return run


def register_on_gpu(op: Any, kernel: Callable[..., Any]) -> None:
    """Run a custom operator by a Triton kernel, where Triton is installed; else its own torch path runs."""
    if find_spec("triton") is not None:
        register_kernel(op, "cuda")(kernel)


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
        return result, tree_map(lambda _: 0, result)

    op.register_vmap(rule)
