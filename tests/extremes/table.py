"""Rows of the table of extremes: an operator, an extreme, a dtype, a device, and the asserted bound."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

HALVES = (torch.bfloat16, torch.float16)
FLOATS = (torch.float64, torch.float32, *HALVES)
BITS = (torch.bool, torch.uint8)

Limit = float | Callable[[torch.dtype], float]
Bound = tuple[Limit, str]


class Measured(NamedTuple):
    """Result of one run of a case.

    Attributes:
        error: the worst error, in the unit that the case names; NaN where a number was expected and none came.
        values: ``"finite"``, ``"Inf"``, ``"NaN"``, or another outcome such as the name of an exception.
        gradients: the same; ``"-"`` where there are none.
    """

    error: float
    values: str = "finite"
    gradients: str = "-"


class On(NamedTuple):
    """What a case is measured on: tensors of a dtype, on a device."""

    dtype: torch.dtype
    device: torch.device


Measure = Callable[[On], Measured | Iterable[Measured]]
Tensors = Tensor | Sequence[Tensor]
Pairs = Sequence[tuple[Tensor, Tensor]]
# residual interpolation divides by squares of differences, which makes 1e2 to 1e5 ulp of float32's own rounding
_SUMMED = {
    **dict.fromkeys(("flow_warp", "flow_warp_idw", "upsample_flow", "linear_motion"), 16.0),
    **dict.fromkeys(("demosaic_residual", "demosaic_along_motion"), 4096.0),
}
_WORSE = ("-", "finite", "Inf", "NaN")


def measured(error: float, values: Tensors = (), gradients: Tensors = ()) -> Measured:
    """Return an error and the states of the tensors that it was found in; without gradients there are none."""
    values, gradients = ([some] if isinstance(some, Tensor) else some for some in (values, gradients))
    return Measured(error, state(*values), state(*gradients) if len(gradients) else "-")


@dataclass(frozen=True)
class Row:
    """One line of the table, with its verdict."""

    operator: str
    extreme: str
    dtype: str
    device: str
    error: float
    limit: float
    bound: str
    values: str
    gradients: str
    passed: bool
    trouble: str = ""


@dataclass(frozen=True)
class Case:
    """An operator at an extreme, in one or more dtypes.

    Attributes:
        operator: name of the public function.
        extreme: what is extreme about it, in words.
        dtypes: in which types it is measured.
        measure: runs it in one dtype on one device; of several results, the worst of each counts.
        limit: the error that is allowed, or a function of the dtype that gives it.
        bound: the same in words, with its unit and where it comes from.
        values: which outcome of the values is right.
        gradients: which outcome of the gradients is right; bool and uint8 have none.
        slow: takes seconds.
        on_gpu: the limit and the bound on a GPU, where they are others.
    """

    operator: str
    extreme: str
    dtypes: tuple[torch.dtype, ...]
    measure: Measure
    limit: Limit
    bound: str
    values: str
    gradients: str
    slow: bool
    on_gpu: Bound | None = None

    def row(self, dtype: torch.dtype, device: torch.device | str = "cpu") -> Row:
        """Measure, and compare with what is allowed; an exception that is not expected is a row that fails."""
        device = torch.device(device)
        limit, bound = (self.limit, self.bound) if device.type == "cpu" or not self.on_gpu else self.on_gpu
        limit = limit(dtype) if callable(limit) else limit
        trouble = ""
        try:
            measured = self.measure(On(dtype, device))
            if not isinstance(measured, Measured):
                errors, *states = zip(*measured, strict=True)
                measured = Measured(worst(*errors), *(max(each, key=_WORSE.index) for each in states))
        except Exception as error:
            measured = Measured(float("nan"), type(error).__name__)
            trouble = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        expected = self.values, self.gradients if dtype.is_floating_point else "-"
        right = measured.error <= limit and (measured.values, measured.gradients) == expected
        return Row(
            self.operator, self.extreme, short(dtype), device.type, measured.error, limit, bound,
            measured.values, measured.gradients, right, trouble,
        )  # fmt: skip


class Cases(list[Case]):
    """The cases of a family."""

    def add(
        self,
        operator: str,
        extreme: str,
        dtypes: Iterable[torch.dtype] = FLOATS,
        *,
        limit: Limit = 0.0,
        bound: str = "0: bit for bit",
        values: str = "finite",
        gradients: str = "finite",
        slow: bool = False,
        on_gpu: Bound | None = None,
    ) -> Callable[[Measure], Measure]:
        """Add the decorated ``measure(on)``, see :class:`Case`."""

        def add(measure: Measure) -> Measure:
            some = tuple(dtypes)
            self.append(Case(operator, extreme, some, measure, limit, bound, values, gradients, slow, on_gpu))
            return measure

        return add


def short(dtype: torch.dtype) -> str:
    """Return ``"float32"`` for ``torch.float32``."""
    return str(dtype).removeprefix("torch.")


def state(*tensors: Tensor) -> str:
    """Return the worst of ``"finite"``, ``"Inf"`` and ``"NaN"`` that is among the numbers."""
    numbers = [tensor.detach().double().flatten() for tensor in tensors]
    if any(number.isnan().any() for number in numbers):
        return "NaN"
    return "Inf" if any(number.isinf().any() for number in numbers) else "finite"


def differ(got: Tensor, expected: Tensor) -> float:
    """Count the elements that are not the same number (NaN equals NaN); infinite where the shapes differ."""
    got, expected = got.detach().double().cpu(), expected.detach().double().cpu()
    if got.shape != expected.shape:
        return float("inf")
    return float(((got != expected) & ~(got.isnan() & expected.isnan())).sum())


def of_largest(got: Tensor, expected: Tensor) -> float:
    """Return the worst error in ulp of the largest number that is expected."""
    if got.shape != expected.shape or not expected.numel():
        return differ(got, expected)
    expected = expected.detach().double().cpu()
    return ulps(got, expected, expected.abs().max().expand(expected.shape))


def apart(values: Pairs, gradients: Pairs, device: torch.device) -> float:
    """Count the elements that are not the same number, in the worst pair of tensors.

    A GPU may add up gradients in any order: there the error is theirs in ulp of the largest, and infinite where values
    are not the same.
    """
    if device.type == "cpu":
        return worst(0.0, *(differ(*pair) for pair in [*values, *gradients]))
    if any(differ(*pair) for pair in values):
        return float("inf")
    return worst(0.0, *(of_largest(*pair) for pair in gradients))


def sums_on_gpu(operator: str) -> Bound | None:
    """Return the bound of :func:`apart` on a GPU where the gradients of an operator are summed by atomics."""
    if operator not in _SUMMED:
        return None
    limit = _SUMMED[operator]
    return limit, f"values bit for bit, gradients {limit:g} ulp of the largest: the order of sums is free"


def ulps(got: Tensor, exact: Tensor, scale: Tensor | None = None) -> float:
    """Return the worst error of ``got`` in units in the last place, of its own dtype, at ``exact`` or at ``scale``."""
    info = torch.finfo(got.dtype)
    got, exact = got.detach().double().cpu(), exact.double()
    if got.shape != exact.shape:
        return float("inf")
    _, exponent = torch.frexp((exact if scale is None else scale).abs())
    ulp = torch.ldexp(torch.full_like(exact, info.eps), exponent - 1).clamp(min=info.tiny * info.eps)
    error = torch.where(got == exact, 0.0, (got - exact).abs() / ulp)  # infinity is equal to infinity
    return float(error.max()) if error.numel() else 0.0


def rounded_once(noise: float) -> Callable[[torch.dtype], float]:
    """Allow ``noise`` ulp in float64 and float32; in half precision half an ulp, and the noise of float32."""

    def limit(dtype: torch.dtype) -> float:
        if dtype not in HALVES:
            return noise
        return 0.5 + noise * torch.finfo(torch.float32).eps / torch.finfo(dtype).eps

    return limit


def worst(*errors: float) -> float:
    """Return the largest, NaN being larger than any."""
    return max(errors, key=lambda error: (error != error, error))


def outcome_of(error: type[Exception], call: Callable[[], object]) -> Measured:
    """Return the name of the exception that ``call`` raises where it is the one that is expected."""
    try:
        call()
    except error as raised:
        return Measured(0.0, type(raised).__name__)
    return Measured(float("nan"), "no error")
