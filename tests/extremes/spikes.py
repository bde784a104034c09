"""Extremes of the decoders: empty and full streams, short clips, windows that do not fit, chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import product
from typing import Any

import brute_force
import torch
from torch import Tensor

import spikekit as sk
from extremes.table import (
    BITS,
    FLOATS,
    HALVES,
    Cases,
    Measured,
    On,
    differ,
    measured,
    outcome_of,
    rounded_once,
    ulps,
)

CASES = Cases()

_ANY = (*FLOATS, *BITS)
_FRAMES = 41
_DECODERS: dict[str, dict[str, Any]] = {"spike_interval": {}, "tfi": {}, "tfp": {"window": 11}}
_RATES = {name: options for name, options in _DECODERS.items() if name != "spike_interval"}


def _every(frames: int) -> Tensor:
    return torch.tensor(list(product([0.0, 1.0], repeat=frames))).T


@cache
def _random(frames: int) -> Tensor:
    """Pixels that fire never to always."""
    density = torch.linspace(0, 1, 12)
    return (torch.rand(frames, 12, generator=torch.Generator().manual_seed(0)) < density).double()


_STREAMS = {  # (T, P)
    "no spike": torch.zeros(_FRAMES, 1),
    "a spike at every clock": torch.ones(_FRAMES, 1),
    "one spike, at the first clock": torch.eye(_FRAMES)[:, :1],
    "one spike, at the last clock": torch.eye(_FRAMES)[:, -1:],
    "clips of 1 frame, all": _every(1),
    "clips of 2 frames, all": _every(2),
    "clips of 3 frames, all": _every(3),
}


def _decode(name: str, stream: Tensor, on: On, weight: Tensor | None = None, /, **options: Any) -> tuple[Tensor, ...]:
    """Decode (T, P); return the result and, where there is one, the gradient of its weighted sum."""
    spikes = stream.to(on.dtype)[:, None].to(on.device).requires_grad_(on.dtype.is_floating_point)
    result = getattr(sk, name)(spikes, **options)
    if not result.requires_grad:
        return (result[:, 0].cpu(),)
    weight = torch.ones_like(stream) if weight is None else weight
    (grad,) = torch.autograd.grad(result, spikes, weight.to(result)[:, None])
    return result[:, 0].detach().cpu(), grad[:, 0].cpu()


@cache  # the same for every dtype
def _by_pixel(function: Callable[..., Any], *streams: Tensor, **options: Any) -> Tensor:
    """Apply a function of one pixel's streams to (T, P)."""
    pixels = zip(*(stream.double().T.tolist() for stream in streams), strict=True)
    columns = [[float(value) for value in function(*pixel, **options)] for pixel in pixels]
    return torch.tensor(columns, dtype=torch.float64).T


def _intervals(stream: Tensor, on: On) -> Measured:
    (result,) = _decode("spike_interval", stream, on)
    return measured(differ(result, _by_pixel(brute_force.spike_interval, stream)), result)


def _rates(name: str, options: dict[str, Any], stream: Tensor, on: On) -> Iterator[Measured]:
    for most in (1.0, 255.0):
        how = {**options, "max_range": most}
        result, *grad = _decode(name, stream, on, **how)
        yield measured(ulps(result, _by_pixel(getattr(brute_force, name), stream, **how)), result, grad)


_ONCE: dict[str, Any] = {"limit": rounded_once(0.5), "bound": "0.5 ulp: rounded once"}

for _extreme, _stream in _STREAMS.items():
    CASES.add("spike_interval", _extreme, _ANY, bound="0 frames", gradients="-")(partial(_intervals, _stream))
    for _name, _options in _RATES.items():
        CASES.add(_name, _extreme, _ANY, **_ONCE)(partial(_rates, _name, _options, _stream))

for _extreme, _window, _stream in (
    ("window of the clip", _FRAMES, _random(_FRAMES)),
    ("window longer than the clip", 2 * _FRAMES + 1, _random(_FRAMES)),
    ("window of 10^12 + 1 frames", 10**12 + 1, _random(_FRAMES)),
    ("300 spikes in one window", 601, torch.ones(300, 1)),
):
    CASES.add("tfp", _extreme, _ANY, **_ONCE)(partial(_rates, "tfp", {"window": _window}, _stream))


def _refused(window: int, on: On) -> Measured:
    return outcome_of(ValueError, lambda: sk.tfp(torch.ones(_FRAMES, 1, 1, dtype=on.dtype, device=on.device), window))


for _window, _extreme in {0: "window 0", 10: "window even"}.items():
    CASES.add("tfp", _extreme, _ANY, bound="an error", values="ValueError", gradients="-")(partial(_refused, _window))


def _long(frames: int, on: On) -> Measured:
    (result,) = _decode("spike_interval", torch.zeros(frames, 1), on)
    return measured(differ(result, torch.full((frames, 1), float(frames + 1)).to(result.dtype)), result)


for _extreme, _frames, _dtypes, _values in (
    ("32,767 dark frames", 32_767, (torch.float32, torch.uint8), "finite"),
    ("70,000 dark frames (no float16)", 70_000, (torch.float16,), "Inf"),
):
    _dark: dict[str, Any] = {"bound": "0 frames", "values": _values, "gradients": "-"}
    CASES.add("spike_interval", _extreme, _dtypes, **_dark)(partial(_long, _frames))


def _pictures(name: str, options: dict[str, Any], on: On) -> Iterator[Measured]:
    """Nearest whole number, half to even, cut to 0 .. 255."""
    stream = _random(_FRAMES)
    for most in (1.0, 255.0, 1000.0):
        how = {**options, "max_range": most}
        (got,) = _decode(name, stream, on, **how, dtype=torch.uint8)
        exact = _by_pixel(getattr(brute_force, name), stream, **how)
        yield measured(differ(got, exact.round().clamp(max=255)), got)


def _agreement(name: str, options: dict[str, Any], on: On) -> Measured:
    """The same bits as from a stream of booleans, rounded to the dtype of the result."""
    stream = _random(_FRAMES)
    expected, got = (_decode(name, stream, on._replace(dtype=kind), **options)[0] for kind in (torch.bool, on.dtype))
    coarser = on.dtype if on.dtype in HALVES else torch.promote_types(expected.dtype, torch.int16)
    return measured(differ(got.to(coarser), expected.to(coarser)), got)


for _name, _options in _DECODERS.items():
    _bits: dict[str, Any] = {"bound": "0: bit for bit", "gradients": "-"}
    if _name in _RATES:
        _extreme = "pictures in uint8, max_range 1, 255, 1000"
        CASES.add(_name, _extreme, _ANY, **_bits)(partial(_pictures, _name, _options))
    CASES.add(_name, "bool, uint8 and float streams agree", _ANY, **_bits)(partial(_agreement, _name, _options))


def _gradient(name: str, options: dict[str, Any], on: On) -> Iterator[Measured]:
    how = {**options, "max_range": 4.0}
    for stream in (*_STREAMS.values(), _random(_FRAMES)):
        weight = torch.randint(1, 9, stream.shape, generator=torch.Generator().manual_seed(0)).double()
        result, grad = _decode(name, stream, on, weight, **how)
        yield measured(
            ulps(grad, _by_pixel(getattr(brute_force, f"{name}_gradient"), stream, weight, **how)), result, grad
        )


for _name, _limit, _bound in (
    ("tfi", lambda dtype: 1.51 if dtype in HALVES else 2.0, "2 ulp, half 1.5: rate and product are rounded"),
    ("tfp", rounded_once(_FRAMES / 2), "half an ulp a frame, half 0.5"),
):
    CASES.add(_name, "gradient by the stated contract", limit=_limit, bound=_bound)(
        partial(_gradient, _name, _DECODERS[_name])
    )
