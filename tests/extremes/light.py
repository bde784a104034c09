"""Extremes of the sensor: no light, too much, negative, NaN, or constant for a very long time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial
from typing import Any

import brute_force
import torch
from torch import Tensor

import spikekit as sk
from extremes.table import FLOATS, Cases, Measured, On, differ, measured, rounded_once, state, ulps, worst

CASES = Cases()

_OP = "spike_integrate_fire"
_INF = float("inf")


def _eps(dtype: torch.dtype) -> float:
    """Relative spacing of the charge, which is float32 or wider."""
    return torch.finfo(torch.promote_types(dtype, torch.float32)).eps


def _in(dtype: torch.dtype, value: float) -> float:
    """Return the number of ``dtype`` that is nearest to ``value``."""
    return torch.tensor(value, dtype=dtype).item()


def _below(dtype: torch.dtype, value: float) -> float:
    at = torch.tensor(value, dtype=dtype)
    return torch.nextafter(at, at * 0).item()


def _fire(
    lights: Sequence[Sequence[float]], threshold: float, on: On, start: float = 0.0
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Run one pixel per sequence; return light, spikes and gradient as (T, P), and the charge left (P)."""
    light = torch.tensor(lights, dtype=torch.float64).to(on.dtype).T[:, None].to(on.device).requires_grad_()
    charge = torch.full((1, 1), start, dtype=torch.promote_types(on.dtype, torch.float32), device=on.device)
    spikes, charge = sk.spike_integrate_fire(light, threshold, charge)
    (grad,) = torch.autograd.grad(spikes.sum(), light)
    return light[:, 0].detach().cpu(), spikes[:, 0].detach().cpu(), grad[:, 0].cpu(), charge[0].cpu()


def _drift(light: Tensor, spikes: Tensor, charge: Tensor, threshold: float, start: float = 0.0) -> float:
    """Return how far spikes and charge are from the exact ones, in spikes; NaN where the count is off by several."""
    theta = Fraction(charge.new_tensor(threshold).item())
    errors = []
    for p in range(light.shape[1]):
        exact, left = brute_force.integrate_fire(light[:, p].tolist(), theta, start)
        early = spikes[:, p].double().cumsum(0) - torch.tensor(exact, dtype=torch.float64).cumsum(0)
        drift = int(early[-1]) + (Fraction(charge[p].item()) - left) / theta
        if light[:, p].max() > threshold:  # a surplus may be a whole threshold, and lost, or not, by its last bit
            drift -= round(drift)
        errors.append(float(abs(drift)) if early.abs().max() <= 1 else float("nan"))
    return worst(*errors)


def _run(lights: Sequence[Sequence[float]], threshold: float, on: On, start: float = 0.0) -> Measured:
    light, spikes, grad, charge = _fire(lights, threshold, on, start)
    return measured(_drift(light, spikes, charge, threshold, start), (spikes, charge), grad)


_EXACT = "0 spikes: nothing to round"
_AN_ULP = "1 ulp of the threshold a clock, in spikes"


def _an_ulp_a_clock(clocks: int, size: float = 1.0) -> Callable[[torch.dtype], float]:
    """Rounding of sums below ``2 * size`` thresholds."""
    return lambda dtype: clocks * size * _eps(dtype)


def _near_the_threshold(near: Callable[[torch.dtype, float], float], on: On) -> Iterator[Measured]:
    for value in (0.1, 0.3, 1, 7, 41, 47):  # 41 * (1 / 41) is below 1 in float32
        threshold = _in(on.dtype, value)
        yield _run([[near(on.dtype, threshold)] * 64], threshold, on)


CASES.add(_OP, "light 0 everywhere", bound=_EXACT)(partial(_run, [[0.0] * 64], 1.0))
CASES.add(_OP, "light at the threshold", bound=_EXACT)(partial(_near_the_threshold, _in))
CASES.add(_OP, "light one ulp below the threshold", limit=_an_ulp_a_clock(64), bound=_AN_ULP)(
    partial(_near_the_threshold, _below)
)


@CASES.add(_OP, "light 1e-12 of the threshold", limit=_an_ulp_a_clock(200), bound=_AN_ULP)
def _(on: On) -> Iterator[Measured]:
    for start in (0.0, _below(torch.float32, 1.0)):
        yield _run([[1e-12] * 200], 1.0, on, start)


@CASES.add(_OP, "light 1e6 thresholds", limit=_an_ulp_a_clock(2, 1e6), bound="1 ulp of the light a clock, in spikes")
def _(on: On) -> Iterator[Measured]:
    for theta in (2.0**-6, _in(on.dtype, 0.03)):  # thresholds for which float16 holds the light as well
        yield _run([[_in(on.dtype, 1e6 * theta)] * 2], theta, on)


_STEPS = [[0.0] * 20 + [level] * 21 + [0.25] * 9 for level in (1.0, 1.5, 8.75)]
CASES.add(_OP, "a step from dark to saturated in one clip", bound=_EXACT)(partial(_run, _STEPS, 1.0))


@CASES.add(_OP, "light below 0: a debt", bound=_EXACT)
def _(on: On) -> Iterator[Measured]:
    ripple = [0.5, -0.0625] * 32
    dip = [0.25] * 8 + [-1.75] + [0.5] * 23
    noise = (torch.randint(-96, 160, (64,), generator=torch.Generator().manual_seed(0)) / 128).tolist()
    for light in (ripple, dip, noise):
        yield _run([light], 1.0, on)


def _broken_pixel(value: float, fires: bool, on: On) -> Measured:
    """One such clock in the middle pixel of three: the others do not notice, and it is as the contract says."""
    steady = [0.375] * 24
    broken = [*steady[:5], value, *steady[6:]]
    _, spikes, grad, charge = _fire([steady, broken, steady], 1.0, on)
    whole, left = brute_force.integrate_fire(steady, 1.0)
    before, _ = brute_force.integrate_fire(steady[:5], 1.0)
    after, after_left = brute_force.integrate_fire(steady[6:], 1.0) if fires else ([False] * 18, value)
    expected = torch.tensor([whole, [*before, fires, *after], whole], dtype=torch.float64).T
    slope = torch.ones_like(expected)
    slope[5, 1] = 0
    error = differ(spikes, expected) + differ(grad, slope)
    error += differ(charge, torch.tensor([float(left), float(after_left), float(left)]))
    broken_charge = state(charge[1])
    return Measured(error, state(spikes) if broken_charge == "finite" else f"charge {broken_charge}", state(grad))


for _extreme, _value, _fires, _values in (
    ("light NaN: silent from then on", float("nan"), False, "charge NaN"),
    ("light +Inf: fires, and is empty", _INF, True, "finite"),
    ("light -Inf: silent from then on", -_INF, False, "charge Inf"),
):
    CASES.add(_OP, _extreme, values=_values)(partial(_broken_pixel, _value, _fires))


def _at_threshold(threshold: float, on: On) -> Measured:
    """Light of up to two thresholds, or what the dtype can hold."""
    most = min(2 * threshold, torch.finfo(on.dtype).max)
    light = torch.rand(4, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * most
    return _run(light.to(on.dtype).tolist(), threshold, on)


_SURPLUS: dict[str, Any] = {"limit": _an_ulp_a_clock(64, 3), "bound": "3 ulp of the threshold a clock, in spikes"}


_TINY = partial(_at_threshold, 1e-6)
CASES.add(_OP, "threshold 1e-6", FLOATS[:3], **_SURPLUS)(_TINY)
CASES.add(_OP, "threshold 1e-6 (1e6 is no float16)", FLOATS[3:], gradients="Inf", **_SURPLUS)(_TINY)
CASES.add(_OP, "threshold 1e6", **_SURPLUS)(partial(_at_threshold, 1e6))


@CASES.add(_OP, "gradient at the ends of [0, threshold]", limit=rounded_once(0.5), bound="0.5 ulp: rounded once")
def _(on: On) -> Iterator[Measured]:
    info = torch.finfo(on.dtype)
    for threshold in (2.0**-10, 0.3, 1.0, 7.0, 1e3):
        at = torch.tensor(threshold, dtype=on.dtype)
        above, below = torch.nextafter(at, at * 2).item(), torch.nextafter(at, at * 0).item()
        lights = [-_INF, -1.0, -info.tiny, -0.0, 0.0, info.tiny, below, at.item(), above, 1e4, _INF, float("nan")]
        light, _, grad, _ = _fire([[one] for one in lights], threshold, on)
        theta = torch.tensor(threshold, dtype=torch.promote_types(on.dtype, torch.float32)).item()
        exact = [float(brute_force.straight_through(one, theta)) for one in light[0].tolist()]
        yield measured(ulps(grad[0], torch.tensor(exact, dtype=torch.float64)), (), grad)


_CLOCKS, _CHUNK = 100_000, 20_000


@CASES.add(
    _OP,
    "constant light over 100,000 clocks",
    (torch.float64, torch.float32),  # narrower light is collected in float32
    limit=lambda dtype: _CLOCKS * _eps(dtype) / 2,
    bound="half an ulp of the charge a clock, in spikes",
    gradients="-",
    slow=True,
)
def _(on: On) -> Measured:
    light = torch.tensor([[1 / 3, 0.1, 0.7, 0.999, 1e-3, 1.0]], dtype=torch.float64).to(on.dtype)
    exact = [Fraction(one) for one in light[0].tolist()]
    clip, charge, errors = light.to(on.device).expand(_CHUNK, *light.shape), None, [0.0]
    counts = torch.zeros(light.shape[1], dtype=torch.int64)
    for clocks in range(_CHUNK, _CLOCKS + 1, _CHUNK):
        spikes, charge = sk.spike_integrate_fire(clip, 1.0, charge, dtype=torch.uint8)
        counts += spikes.sum(0)[0].cpu()
        for count, left, one in zip(counts.tolist(), charge[0].tolist(), exact, strict=True):
            late = abs(count - clocks * one.numerator // one.denominator) > 1
            errors.append(float("nan") if late else float(abs(count + Fraction(left) - clocks * one)))
    return measured(worst(*errors), charge)
