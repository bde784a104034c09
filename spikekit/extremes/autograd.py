"""Extremes of autograd: derivatives, compile, export, autocast, vmap and deterministic mode."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from spikekit.examples import EXAMPLES, Example
from spikekit.extremes.table import Cases, Measured, differ, state

CASES = Cases()

_FLOAT32 = (torch.float32,)
_FLOAT64 = (torch.float64,)
# even, for the cells of a Bayer filter; torch.compile takes what has length 1 for a constant: none at half the size
_SIZES = ((10, 14), (16, 12), (12, 18), (14, 16))


def _inputs(
    operator: Example, dtype: torch.dtype, device: torch.device, size: tuple[int, int] = _SIZES[0]
) -> list[Tensor]:
    return [tensor.to(dtype).to(device) for tensor in operator.tensors((2,), size)]


def _first_and_gradients(call: Callable[..., Any], tensors: list[Tensor]) -> list[Tensor]:
    """Return the first result, and the gradients of its weighted sum where it has any."""
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    results = call(*leaves)
    result = results[0] if isinstance(results, tuple) else results
    if not result.requires_grad:
        return [result]
    weight = torch.arange(1.0, result.numel() + 1, device=result.device).to(result.dtype).reshape(result.shape)
    return [result.detach(), *torch.autograd.grad(result, leaves, weight)]


def _measured(error: float, tensors: list[Tensor]) -> Measured:
    return Measured(error, state(tensors[0]), state(*tensors[1:]) if len(tensors) > 1 else "-")


def _compare(got: list[Tensor], expected: list[Tensor]) -> float:
    return sum(map(differ, got, expected)) if len(got) == len(expected) else float("inf")


def _finite_differences(operator: Example, twice: bool, dtype: torch.dtype, device: torch.device) -> Measured:
    leaves = [tensor.to(device, dtype).requires_grad_() for tensor in operator.tensors((1,), (4, 6))]
    check = gradgradcheck if twice else gradcheck
    check(operator.call, tuple(leaves))  # raises where they differ
    return _measured(0.0, _first_and_gradients(operator.call, leaves))


def _compiled(operator: Example, dtype: torch.dtype, device: torch.device) -> Measured:
    """Count the compiles after the first; the result is that of the operator."""
    from torch._dynamo.testing import CompileCounterWithBackend

    torch.compiler.reset()
    counter = CompileCounterWithBackend("aot_eager")
    compiled = torch.compile(operator.call, fullgraph=True, dynamic=True, backend=counter)
    first, found = 0, []
    for size in _SIZES:
        tensors = _inputs(operator, dtype, device, size)
        with torch._dynamo.config.patch(specialize_int=True):  # a scale is a constant; sizes are not
            found = _first_and_gradients(compiled, tensors)
        for got, expected in zip(found, _first_and_gradients(operator.call, tensors), strict=True):
            torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)
        first = first or counter.frame_count
    return _measured(counter.frame_count - first, found)


class _Module(torch.nn.Module):
    def __init__(self, operator: Example) -> None:
        super().__init__()
        self.call = operator.call

    def forward(self, *tensors: Tensor) -> Tensor:
        return self.call(*tensors)


def _exported(operator: Example, dtype: torch.dtype, device: torch.device) -> Measured:
    """One program of a batch of any size."""
    tensors = _inputs(operator, dtype, device)
    batch = torch.export.Dim("batch")
    shapes = tuple({operator.axis_in: batch} for _ in tensors)
    program = torch.export.export(_Module(operator), tuple(tensors), dynamic_shapes=(shapes,), strict=False).module()
    error, result = 0.0, tensors[0]
    for repeats in (1, 3):
        batches = [torch.cat([tensor] * repeats, dim=operator.axis_in) for tensor in tensors]
        results = program(*batches)
        result = results[0] if isinstance(results, tuple) else results
        error += differ(result, operator.results(*batches)[0])
    return Measured(error, state(result))


def _autocast(operator: Example, dtype: torch.dtype, device: torch.device) -> Measured:
    tensors = _inputs(operator, dtype, device)
    expected = _first_and_gradients(operator.call, tensors)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        got = _first_and_gradients(operator.call, tensors)
    kept = all(tensor.dtype == dtype for tensor in got)
    return _measured(_compare(got, expected) if kept else float("inf"), got)


def _vmapped(operator: Example, dtype: torch.dtype, device: torch.device) -> Measured:
    """Results and gradients of a batch by vmap are those of its items."""
    tensors = _inputs(operator, dtype, device)

    def gradients(*items: Tensor) -> tuple[Tensor, ...]:
        result, pull = torch.func.vjp(lambda *leaves: operator.results(*leaves)[0], *items)
        return result, *pull(torch.ones_like(result))

    one = (lambda *items: operator.results(*items)[:1]) if operator.name == "spike_interval" else gradients
    got = list(torch.func.vmap(one, in_dims=operator.axis_in)(*tensors))
    items = [one(*(tensor.select(operator.axis_in, i) for tensor in tensors)) for i in range(2)]
    expected = [torch.stack(parts) for parts in zip(*items, strict=True)]
    return _measured(_compare(got, expected), got)


def _functional(operator: Example, dtype: torch.dtype, device: torch.device) -> Measured:
    """torch.func.grad gives what autograd gives."""
    tensors = _inputs(operator, dtype, device)
    every = tuple(range(len(tensors)))
    got = torch.func.grad(lambda *leaves: operator.results(*leaves)[0].sum(), argnums=every)(*tensors)
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    expected = torch.autograd.grad(operator.results(*leaves)[0].sum(), leaves)
    return Measured(_compare(list(got), list(expected)), "finite", state(*got))


@contextmanager
def _deterministic_mode() -> Iterator[None]:
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)


def _deterministic(operator: Example, dtype: torch.dtype, device: torch.device) -> Measured:
    tensors = _inputs(operator, dtype, device)
    with _deterministic_mode():
        first, second = (_first_and_gradients(operator.call, tensors) for _ in range(2))
    return _measured(_compare(second, first), second)


for _operator in EXAMPLES:
    _gradients = "-" if _operator.name == "spike_interval" else "finite"
    _name = _operator.name
    for _order, _twice in ((1, False), (2, True)):
        if _operator.smooth >= _order:
            _check = "gradgradcheck" if _twice else "gradcheck"
            CASES.add(_name, _check, _FLOAT64, bound="finite differences")(
                partial(_finite_differences, _operator, _twice)
            )
    CASES.add(
        _name,
        "torch.compile, fullgraph",
        _FLOAT64,
        bound="0 recompiles for 3 more sizes",
        gradients=_gradients,
        slow=True,
    )(partial(_compiled, _operator))
    CASES.add(_name, "torch.export, batch of any size", _FLOAT32, gradients="-")(partial(_exported, _operator))
    CASES.add(_name, "torch.autocast", _FLOAT32, gradients=_gradients)(partial(_autocast, _operator))
    CASES.add(_name, "torch.func.vmap", _FLOAT32, gradients=_gradients)(partial(_vmapped, _operator))
    if _gradients == "finite":
        CASES.add(_name, "torch.func.grad", _FLOAT32)(partial(_functional, _operator))
    CASES.add(_name, "deterministic mode", _FLOAT32, gradients=_gradients)(partial(_deterministic, _operator))
