"""Extremes of autograd: derivatives, compile, export, autocast, vmap and deterministic mode."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from operator_examples import EXAMPLES, Example
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from extremes.table import Cases, Measured, On, apart, differ, measured, sums_on_gpu

CASES = Cases()

_FLOAT32 = (torch.float32,)
_FLOAT64 = (torch.float64,)
# even, for the cells of a Bayer filter; torch.compile takes what has length 1 for a constant: none at half the size
_SIZES = ((10, 14), (16, 12), (14, 18))


# grid_sample, which they are made of, may have no second derivative on a GPU; in deterministic mode they do without
_SAMPLED = ("flow_warp", "demosaic_along_motion")


def _inputs(operator: Example, on: On, size: tuple[int, int] = _SIZES[0]) -> list[Tensor]:
    return [tensor.to(on.dtype).to(on.device) for tensor in operator.tensors((2,), size)]


def _first_and_gradients(call: Callable[..., Any], tensors: list[Tensor]) -> list[Tensor]:
    """Return the first result, and the gradients of its weighted sum where it has any."""
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    results = call(*leaves)
    result = results[0] if isinstance(results, tuple) else results
    if not result.requires_grad:
        return [result]
    weight = torch.arange(1.0, result.numel() + 1, device=result.device).to(result.dtype).reshape(result.shape)
    return [result.detach(), *torch.autograd.grad(result, leaves, weight)]


def _compare(got: list[Tensor], expected: list[Tensor], values: int = 1) -> float:
    """Compare values, of which there are so many, and the gradients that follow them."""
    if len(got) != len(expected):
        return float("inf")
    pairs = list(zip(got, expected, strict=True))
    return apart(pairs[:values], pairs[values:], got[0].device)


@contextmanager
def _reproducible() -> Iterator[None]:
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)


def _finite_differences(operator: Example, check: partial[bool], on: On) -> Measured:
    leaves = [tensor.to(on.device, on.dtype).requires_grad_() for tensor in operator.tensors((1,), (4, 6))]
    call, tolerance = operator.call, 0.0
    if on.device.type != "cpu":
        tolerance = 1e-5  # the order of sums is free
        if check.func is not gradcheck and operator.name in _SAMPLED:
            call = _reproducible()(call)
    check(call, tuple(leaves), nondet_tol=tolerance)  # raises where they differ
    result, *grads = _first_and_gradients(operator.call, leaves)
    return measured(0.0, result, grads)


def _compiled(operator: Example, on: On) -> Measured:
    """Count the compiles after the first; the result is that of the operator."""
    from torch._dynamo.testing import CompileCounterWithBackend

    torch.compiler.reset()
    counter = CompileCounterWithBackend("eager")
    compiled = torch.compile(operator.call, fullgraph=True, dynamic=True, backend=counter)
    first, found = 0, []
    for size in _SIZES:
        tensors = _inputs(operator, on, size)
        # a scale is a constant, sizes are not; to look up sizes in the cache takes longer than to compute them
        with torch._dynamo.config.patch(specialize_int=True, fake_tensor_cache_enabled=False):
            found = _first_and_gradients(compiled, tensors)
        for got, expected in zip(found, _first_and_gradients(operator.call, tensors), strict=True):
            torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)
        first = first or counter.frame_count
    return measured(counter.frame_count - first, found[0], found[1:])


class _Module(torch.nn.Module):
    def __init__(self, operator: Example) -> None:
        super().__init__()
        self.call = operator.call

    def forward(self, *tensors: Tensor) -> Tensor:
        return self.call(*tensors)


def _exported(operator: Example, on: On) -> Measured:
    """One program of a batch of any size."""
    tensors = _inputs(operator, on)
    batch = torch.export.Dim("batch")
    shapes = tuple({operator.axis_in: batch} for _ in tensors)
    program = torch.export.export(_Module(operator), tuple(tensors), dynamic_shapes=(shapes,), strict=False).module()
    error, result = 0.0, tensors[0]
    for repeats in (1, 3):
        batches = [torch.cat([tensor] * repeats, dim=operator.axis_in) for tensor in tensors]
        results = program(*batches)
        result = results[0] if isinstance(results, tuple) else results
        error += differ(result, operator.results(*batches)[0])
    return measured(error, result)


def _autocast(operator: Example, on: On) -> Measured:
    tensors = _inputs(operator, on)
    expected = _first_and_gradients(operator.call, tensors)
    with torch.autocast(on.device.type, dtype=torch.bfloat16):
        got = _first_and_gradients(operator.call, tensors)
    kept = all(tensor.dtype == on.dtype for tensor in got)
    return measured(_compare(got, expected) if kept else float("inf"), got[0], got[1:])


def _vmapped(operator: Example, on: On) -> Measured:
    """Results and gradients of a batch by vmap are those of its items."""
    tensors = _inputs(operator, on)

    def gradients(*items: Tensor) -> tuple[Tensor, ...]:
        result, pull = torch.func.vjp(lambda *leaves: operator.results(*leaves)[0], *items)
        return result, *pull(torch.ones_like(result))

    one = (lambda *items: gradients(*items)[:1]) if operator.name == "spike_interval" else gradients
    got = list(torch.func.vmap(one, in_dims=operator.axis_in)(*tensors))
    items = [one(*(tensor.select(operator.axis_in, i) for tensor in tensors)) for i in range(2)]
    expected = [torch.stack(parts) for parts in zip(*items, strict=True)]
    return measured(_compare(got, expected), got[0], got[1:])


def _functional(operator: Example, on: On) -> Measured:
    """torch.func.grad gives what autograd gives."""
    tensors = _inputs(operator, on)
    every = tuple(range(len(tensors)))
    got = torch.func.grad(lambda *leaves: operator.results(*leaves)[0].sum(), argnums=every)(*tensors)
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    expected = torch.autograd.grad(operator.results(*leaves)[0].sum(), leaves)
    return measured(_compare(list(got), list(expected), values=0), (), got)


def _deterministic(operator: Example, on: On) -> Measured:
    tensors = _inputs(operator, on)
    with _reproducible():
        first, second = (_first_and_gradients(operator.call, tensors) for _ in range(2))
    return measured(_compare(second, first, values=len(second)), second[0], second[1:])


_COMPILED = {"bound": "0 recompiles for 2 more sizes", "slow": True}
for _operator in EXAMPLES:
    _gradients = "-" if _operator.name == "spike_interval" else "finite"
    # of the longest compositions, whose parts are checked in all directions, a random one: all would take 15 seconds
    _long = _operator.name in ("demosaic_residual", "demosaic_along_motion")
    for _order, _check in enumerate((gradcheck, gradgradcheck), 1):
        if _operator.smooth >= _order:
            _measure = partial(_finite_differences, _operator, partial(_check, fast_mode=_long))
            _bound = "finite differences, a random direction" if _long else "finite differences"
            _on_gpu = (0.0, f"{_bound}, in deterministic mode") if _order == 2 and _operator.name in _SAMPLED else None
            CASES.add(_operator.name, f"{'grad' * _order}check", _FLOAT64, bound=_bound, on_gpu=_on_gpu)(_measure)
    _summed: dict[str, Any] = {"on_gpu": sums_on_gpu(_operator.name)}
    for _extreme, _of, _dtypes, _how in (
        ("torch.compile, fullgraph", _compiled, _FLOAT64, {"gradients": _gradients, **_COMPILED}),
        ("torch.export, batch of any size", _exported, _FLOAT32, {"gradients": "-"}),
        ("torch.autocast", _autocast, _FLOAT32, {"gradients": _gradients, **_summed}),
        ("torch.func.vmap", _vmapped, _FLOAT32, {"gradients": _gradients, **_summed}),
        ("torch.func.grad", _functional, _FLOAT32, _summed),
        ("deterministic mode", _deterministic, _FLOAT32, {"gradients": _gradients}),
    ):
        if _of is not _functional or _gradients != "-":
            CASES.add(_operator.name, _extreme, _dtypes, **_how)(partial(_of, _operator))
