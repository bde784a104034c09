"""Fast CPU and GPU kernels of the heavy operators; each operator's module has its plain torch path."""

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

NUMBA, TRITON = (find_spec(name) is not None for name in ("numba", "triton"))


def operator(fake: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Turn the decorated function into a custom operator with any number of leading dimensions.

    The operator has the name of the function without the underscore. The functions of that name in
    :mod:`spikekit.kernels.cpu` and :mod:`spikekit.kernels.gpu`, if they exist, are its kernels.

    Args:
        fake: function of the same arguments that returns empty tensors of the shapes and dtypes of the results.
    """

    def make(plain: Callable[..., Any]) -> Any:
        name = plain.__name__.removeprefix("_")
        op = custom_operator(name, plain, fake)
        if hasattr(cpu, name):
            register_kernel(op, "cpu")(getattr(cpu, name))
            register_kernel(op, "cuda")(lambda *args: gpu_kernel(name)(*args))
        register_vmap(op)
        return op

    return make


def custom_operator(name: str, plain: Callable[..., Any], fake: Callable[..., Any]) -> Any:
    """Create the custom operator ``spikekit::name``; devices without a kernel run ``plain``."""
    op = torch.library.custom_op(f"spikekit::{name}", plain, mutates_args=(), device_types=())
    op.register_fake(fake)
    register_kernel(op, "default")(plain)
    return op


def register_kernel(op: Any, device: str) -> Callable[[Callable[..., Any]], None]:
    """Register the decorated function as the kernel of a custom operator on a type of device.

    Kernels for CUDA need Triton, and are left out without it. The operator's own ``register_kernel`` imports the
    compiler at the first call, which takes a second or two, and checks for aliasing of results and arguments at every
    call, which a test does here.
    """
    if device == "cuda" and not TRITON:
        return lambda kernel: None
    return lambda kernel: torch.library.impl(f"spikekit::{op._name}", device, compiler_kept_out(kernel))


def compiler_kept_out(function: Callable[..., Any]) -> Callable[..., Any]:
    """Exclude a function from compilation, like ``torch.compiler.disable`` but without importing the compiler."""
    disabled = torch._disable_dynamo(function)  # imports the compiler when called

    @wraps(function)
    def run(*args: Any, **options: Any) -> Any:
        return (disabled if "torch._dynamo" in sys.modules else function)(*args, **options)

    return run


def gpu_kernel(name: str) -> Callable[..., Any]:
    """Return a function of :mod:`spikekit.kernels.gpu`, which is imported lazily."""
    return getattr(import_module("spikekit.kernels.gpu"), name)


def import_loops(module: str) -> Any:
    """Import a module with loops compiled by Numba; return None if Numba is missing or does not work."""
    try:
        return import_module(module) if NUMBA else None
    except ImportError:  # incompatible with the installed NumPy
        return None


def register_vmap(op: Any, folded: int = 0) -> None:
    """Register a ``torch.func.vmap`` rule that adds the mapped axis as a leading dimension of every tensor.

    With ``folded``, the axis is folded into the first dimension of that many arguments; others cannot be mapped over.
    """

    def rule(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
        count = folded or len(args)
        if any(dim is not None for dim in in_dims[count:]):
            raise ValueError(f"{op._name}: expected only the first {count} arguments to be mapped over")

        def with_axis(value: Any, dim: int | None) -> Any:
            if not isinstance(value, Tensor):
                return value
            value = value.expand(info.batch_size, *value.shape) if dim is None else value.movedim(dim, 0)
            return value.flatten(0, 1) if folded else value

        result = op(*map(with_axis, args[:count], in_dims), *args[count:])
        if folded:
            result = tree_map(lambda value: value.unflatten(0, (info.batch_size, -1)), result)
        return result, tree_map(lambda _: 0, result)

    op.register_vmap(rule)
