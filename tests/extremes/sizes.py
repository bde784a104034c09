"""Extremes of size: empty batches, many leading dimensions, every memory layout, a camera-sized stream."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from operator_examples import EXAMPLES, Example
from torch import Tensor

import spikekit as sk
from extremes.table import Cases, Measured, On, apart, differ, measured, of_largest, sums_on_gpu, worst

CASES = Cases()

_FLOAT32 = (torch.float32,)
_STATUS = Path("/proc/self/status")
_ANY_ORDER = "flow_warp"  # operators of such a name sum values in the order that the memory layout suggests


def _run(operator: Example, tensors: tuple[Tensor, ...], device: torch.device) -> tuple[list[Tensor], list[Tensor]]:
    """Results, and gradients of their sum by the inputs, which keep their strides."""
    # a view of a leaf, so that the operator sees the strides of the input
    leaves = [tensor.to(device).requires_grad_() for tensor in tensors]
    results = operator.results(*leaves)
    total = sum(result.sum() for result in results if result.requires_grad)
    if not isinstance(total, Tensor):
        return list(results), []
    return [result.detach() for result in results], list(torch.autograd.grad(total, leaves))


def _empty_batch(operator: Example, on: On) -> Measured:
    one = [tensor.to(on.dtype) for tensor in operator.tensors((1,))]
    none = tuple(tensor.narrow(operator.axis_in, 0, 0) for tensor in one)
    expected, _ = _run(operator, tuple(one), on.device)
    results, grads = _run(operator, none, on.device)
    error = sum(
        differ(result, like.narrow(operator.axis_out, 0, 0)) for result, like in zip(results, expected, strict=True)
    )
    error += sum(differ(grad, tensor) for grad, tensor in zip(grads, none, strict=False))
    return measured(error, results, grads)


def _leading(operator: Example, on: On) -> Measured:
    """(2, 1, 3, ...) is six times the same as one."""
    tensors = [tensor.to(on.dtype) for tensor in operator.tensors((2, 1, 3))]
    results, grads = _run(operator, tuple(tensors), on.device)
    errors, into, out = [], operator.axis_in, operator.axis_out
    for i in range(2):
        for j in range(3):
            alone, alone_grads = _run(operator, tuple(_item(tensor, into, i, j) for tensor in tensors), on.device)
            values = [(_item(all_, out, i, j), one) for all_, one in zip(results, alone, strict=True)]
            gradients = [(_item(all_, into, i, j), one) for all_, one in zip(grads, alone_grads, strict=True)]
            errors.append(apart(values, gradients, on.device))
    return measured(worst(*errors), results, grads)


def _item(tensor: Tensor, axis: int, i: int, j: int) -> Tensor:
    return tensor.select(axis + 2, j).select(axis + 1, 0).select(axis, i)


def _same(operator: Example, views: list[Tensor], device: torch.device) -> Measured:
    """A view gives what its contiguous copy gives, in ulp of the largest number; values of one order exactly."""
    expected, expected_grads = _run(operator, tuple(view.contiguous().clone() for view in views), device)
    results, grads = _run(operator, tuple(view.detach() for view in views), device)
    errors = [of_largest(*pair) for pair in zip(results, expected, strict=True)]
    if any(errors) and not operator.name.startswith(_ANY_ORDER):
        return measured(float("inf"), results, grads)
    errors += [of_largest(*pair) for pair in zip(grads, expected_grads, strict=True)]
    return measured(worst(*errors), results, grads)


def _strided(operator: Example, on: On) -> Measured:
    wide = [tensor.to(on.dtype) for tensor in operator.tensors((2,), (12, 8))]
    views = [tensor.mT[..., ::2, ::2].flip(operator.axis_in) for tensor in wide]
    reversed_ = [view.movedim(operator.axis_in, -1).contiguous().movedim(-1, operator.axis_in) for view in views]
    return _same(operator, reversed_, on.device)


def _expanded(operator: Example, on: On) -> Measured:
    one = [tensor.to(on.dtype) for tensor in operator.tensors((1,))]
    shapes = [[*tensor.shape] for tensor in one]
    for shape in shapes:
        shape[operator.axis_in] = 3
    return _same(operator, [tensor.expand(shape) for tensor, shape in zip(one, shapes, strict=True)], on.device)


def _channels_last(operator: Example, on: On) -> Measured:
    tensors = [tensor.to(on.dtype) for tensor in operator.tensors((2,))]
    last = [tensor.movedim(-3, -1).contiguous().movedim(-1, -3) for tensor in tensors]
    return _same(operator, last, on.device)


_EXACT: dict[str, Any] = {"bound": "0: bit for bit"}
_IN_ANY_ORDER: dict[str, Any] = {"limit": 4.0, "bound": "4 ulp: the order of sums is free"}
_ON_GPU = 16.0, "16 ulp: the order of sums is free"

for _operator in EXAMPLES:
    _gradients = "-" if _operator.name == "spike_interval" else "finite"
    _any_order = _operator.name.startswith(_ANY_ORDER)
    _free = {"on_gpu": sums_on_gpu(_operator.name)}
    _layout = {**_IN_ANY_ORDER, "on_gpu": _ON_GPU} if _any_order else {**_EXACT, **_free}
    for _extreme, _measure, _bound in (
        ("batch of 0", _empty_batch, _EXACT),
        ("leading dimensions (2, 1, 3)", _leading, {**_EXACT, **_free}),
        ("non-contiguous", _strided, _layout),
        ("expanded", _expanded, _layout),
        ("channels last", _channels_last, _layout),
    ):
        CASES.add(_operator.name, _extreme, _FLOAT32, gradients=_gradients, **_bound)(partial(_measure, _operator))


def _bits() -> Tensor:
    return (torch.arange(1000000).reshape(1000, 1000) % 3 == 0).to(torch.uint8).expand(100, 1000, 1000)


def _light() -> Tensor:
    return torch.linspace(0, 1, 1000000).reshape(1000, 1000).expand(100, 1000, 1000)


def _peak() -> int:
    return next(int(line.split()[1]) * 1024 for line in _STATUS.open() if line.startswith("VmHWM"))


def _beside(call: Callable[[Tensor], Tensor], make: Callable[[], Tensor], on: On) -> float:
    """Bytes a pixel that an operator takes beside its input and its result."""
    cuda = on.device.type == "cuda"
    call(torch.zeros(3, 4, 4, dtype=on.dtype, device=on.device))
    stream = make().to(on.device)
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated() if cuda else _peak()
    result = call(stream)
    after = torch.cuda.max_memory_allocated() if cuda else _peak()
    return max((after - before - result.nbytes) / result.numel(), 0.0)


def _memory(call: Callable[[Tensor], Tensor], make: Callable[[], Tensor], on: On) -> Measured:
    """Measure it; on the CPU in a process of its own, whose peak is that of the operator."""
    if on.device.type == "cuda":
        return Measured(_beside(call, make, on))
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()

    def measure() -> None:
        torch.set_num_threads(1)
        theirs.send(_beside(call, make, on))

    process = context.Process(target=measure)
    process.start()
    theirs.close()
    found = ours.recv()  # EOFError where the process has failed
    process.join()
    return Measured(found)


_BESIDE = "1 byte a pixel beside input and result"
_STREAM: dict[str, Any] = {"limit": 1.0, "bound": _BESIDE, "gradients": "-", "slow": True}
if _STATUS.exists():
    for _name, _call in {
        "spike_interval": sk.spike_interval,
        "tfi": lambda stream: sk.tfi(stream, 255.0, dtype=torch.uint8),
        "tfp": lambda stream: sk.tfp(stream, 41, 255.0, dtype=torch.uint8),
    }.items():
        _on_gpu = (2.1, "int16 a pixel: the next spike") if _name == "tfi" else None
        CASES.add(_name, "1000 x 1000 x 100 stream", (torch.uint8,), on_gpu=_on_gpu, **_STREAM)(
            partial(_memory, _call, _bits)
        )
    CASES.add("spike_integrate_fire", "1000 x 1000 x 100 stream", _FLOAT32, **_STREAM)(
        partial(_memory, lambda light: sk.spike_integrate_fire(light, dtype=torch.uint8)[0], _light)
    )
