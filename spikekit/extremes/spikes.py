"""Extremes of the decoders: empty and full streams, short clips, windows that do not fit, chunks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor

import spikekit as sk
from spikekit.extremes import reference
from spikekit.extremes.table import (
    BITS,
    FLOATS,
    HALVES,
    Cases,
    Measured,
    differ,
    outcome_of,
    rounded_once,
    state,
    ulps,
    worst,
)

CASES = Cases()

_ANY = (*FLOATS, *BITS)
_FRAMES = 41
_DECODERS: dict[str, dict[str, Any]] = {"spike_interval": {}, "tfi": {}, "tfp": {"window": 11}}
_RATES = {name: options for name, options in _DECODERS.items() if name != "spike_interval"}
_RANGES = ({"max_range": 1.0}, {"max_range": 255.0})


def _every(frames: int) -> Tensor:
    return torch.tensor(list(product([0.0, 1.0], repeat=frames))).T


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


def _decode(
    name: str, stream: Tensor, dtype: torch.dtype, device: torch.device, weight: Tensor | None = None, /, **options: Any
) -> tuple[Tensor, Tensor | None]:
    """Decode (T, P); return the result and, where there is one, the gradient of its weighted sum."""
    spikes = stream.to(dtype)[:, None].to(device).requires_grad_(dtype.is_floating_point)
    result = getattr(sk, name)(spikes, **options)
    if not result.requires_grad:
        return result[:, 0].cpu(), None
    weight = torch.ones_like(stream) if weight is None else weight
    (grad,) = torch.autograd.grad(result, spikes, weight.to(result)[:, None])
    return result[:, 0].detach().cpu(), grad[:, 0].cpu()


def _by_pixel(function: Callable[..., Any], *streams: Tensor, **options: Any) -> Tensor:
    """Apply a function of one pixel's streams to (T, P)."""
    pixels = zip(*(stream.double().T.tolist() for stream in streams), strict=True)
    columns = [[float(value) for value in function(*pixel, **options)] for pixel in pixels]
    return torch.tensor(columns, dtype=torch.float64).T


def _intervals(stream: Tensor, dtype: torch.dtype, device: torch.device) -> Measured:
    result, _ = _decode("spike_interval", stream, dtype, device)
    return Measured(differ(result, _by_pixel(reference.spike_interval, stream)), state(result))


def _rates(name: str, options: dict[str, Any], stream: Tensor, dtype: torch.dtype, device: torch.device) -> Measured:
    errors, results, grads = [], [], []
    for most in _RANGES:
        result, grad = _decode(name, stream, dtype, device, **options, **most)
        errors.append(ulps(result, _by_pixel(getattr(reference, name), stream, **options, **most)))
        results.append(result)
        grads += [] if grad is None else [grad]
    return Measured(worst(*errors), state(*results), state(*grads) if grads else "-")


_ONCE: dict[str, Any] = {"limit": rounded_once(0.5), "bound": "0.5 ulp: rounded once"}

for _extreme, _stream in _STREAMS.items():
    CASES.add("spike_interval", _extreme, _ANY, bound="0 frames", gradients="-")(partial(_intervals, _stream))
    for _name, _options in _RATES.items():
        CASES.add(_name, _extreme, _ANY, **_ONCE)(partial(_rates, _name, _options, _stream))

for _extreme, _window in {
    "window of the clip": _FRAMES,
    "window longer than the clip": 2 * _FRAMES + 1,
    "window of 10^12 + 1 frames": 10**12 + 1,
}.items():
    CASES.add("tfp", _extreme, _ANY, **_ONCE)(partial(_rates, "tfp", {"window": _window}, _random(_FRAMES)))
CASES.add("tfp", "300 spikes in one window", _ANY, **_ONCE)(partial(_rates, "tfp", {"window": 601}, torch.ones(300, 1)))


def _refused(window: int, dtype: torch.dtype, device: torch.device) -> Measured:
    return outcome_of(ValueError, lambda: sk.tfp(torch.ones(_FRAMES, 1, 1, dtype=dtype, device=device), window))


for _window, _extreme in {0: "window 0", 10: "window even"}.items():
    CASES.add("tfp", _extreme, _ANY, bound="an error", values="ValueError", gradients="-")(partial(_refused, _window))


def _long(frames: int, dtype: torch.dtype, device: torch.device) -> Measured:
    result, _ = _decode("spike_interval", torch.zeros(frames, 1), dtype, device)
    expected = torch.full((frames, 1), float(frames + 1)).to(result.dtype)
    return Measured(differ(result, expected), state(result))


CASES.add("spike_interval", "32,767 dark frames", (torch.float32, torch.uint8), bound="0 frames", gradients="-")(
    partial(_long, 32_767)
)
CASES.add(
    "spike_interval", "70,000 dark frames (no float16)", (torch.float16,), bound="0 frames", values="Inf", gradients="-"
)(partial(_long, 70_000))


def _pictures(name: str, options: dict[str, Any], dtype: torch.dtype, device: torch.device) -> Measured:
    """Nearest whole number, half to even, cut to 0 .. 255."""
    stream, error = _random(_FRAMES), 0.0
    for most in (1.0, 255.0, 1000.0):
        got, _ = _decode(name, stream, dtype, device, **options, max_range=most, dtype=torch.uint8)
        exact = _by_pixel(
            lambda *args, **keywords: [min(round(rate), 255) for rate in getattr(reference, name)(*args, **keywords)],
            stream, **options, max_range=most,
        )  # fmt: skip
        error += differ(got, exact)
    return Measured(error, state(got))


def _agreement(name: str, options: dict[str, Any], dtype: torch.dtype, device: torch.device) -> Measured:
    """The same bits as from a stream of booleans, rounded to the dtype of the result."""
    stream = _random(_FRAMES)
    expected, _ = _decode(name, stream, torch.bool, device, **options)
    got, _ = _decode(name, stream, dtype, device, **options)
    coarser = dtype if dtype in HALVES else torch.promote_types(expected.dtype, torch.int16)
    return Measured(differ(got.to(coarser), expected.to(coarser)), state(got))


def _chunked(name: str, options: dict[str, Any], dtype: torch.dtype, device: torch.device) -> Measured:
    """Chunks that overlap by what the operator looks at: half a window, or two of the longest intervals."""
    frames, longest = 120, 9
    phase = torch.arange(12) % longest
    stream = ((torch.arange(frames)[:, None] + phase) % (1 + phase) == 0).double()
    reach = options["window"] // 2 if options else 2 * longest
    whole, _ = _decode(name, stream, dtype, device, **options)
    parts = []
    for begin in range(0, frames, 20):
        first, last = max(begin - reach, 0), begin + 20 + reach
        part, _ = _decode(name, stream[first:last], dtype, device, **options)
        parts.append(part[begin - first : begin - first + 20])
    return Measured(differ(torch.cat(parts), whole), state(whole))


for _name, _options in _DECODERS.items():
    _bits: dict[str, Any] = {"bound": "0: bit for bit", "gradients": "-"}
    if _options or _name == "tfi":
        CASES.add(_name, "pictures in uint8, max_range 1, 255, 1000", _ANY, **_bits)(
            partial(_pictures, _name, _options)
        )
    CASES.add(_name, "bool, uint8 and float streams agree", _ANY, **_bits)(partial(_agreement, _name, _options))
    CASES.add(_name, "chunks that overlap equal the whole", _ANY, **_bits)(partial(_chunked, _name, _options))


@CASES.add("spike_integrate_fire", "chunks equal the whole", gradients="-")
def _(dtype: torch.dtype, device: torch.device) -> Measured:
    light = (2 * torch.rand(60, 3, 4, generator=torch.Generator().manual_seed(0)) - 0.25).to(dtype).to(device)
    whole, left = sk.spike_integrate_fire(light, 0.3)
    charge, error = None, 0.0
    for begin, end in ((0, 1), (1, 20), (20, 60)):
        part, charge = sk.spike_integrate_fire(light[begin:end], 0.3, charge)
        error += differ(part, whole[begin:end])
    return Measured(error + differ(charge, left), state(whole, left))


def _gradient(name: str, options: dict[str, Any], dtype: torch.dtype, device: torch.device) -> Measured:
    errors, grads = [], []
    for stream in (*_STREAMS.values(), _random(_FRAMES)):
        weight = torch.randint(1, 9, stream.shape, generator=torch.Generator().manual_seed(0)).double()
        result, grad = _decode(name, stream, dtype, device, weight, **options, max_range=4.0)
        assert grad is not None, f"{name}: the result of {dtype} spikes has no gradient"
        exact = _by_pixel(getattr(reference, f"{name}_gradient"), stream, weight, **options, max_range=4.0)
        errors.append(ulps(grad, exact))
        grads.append(grad)
    return Measured(worst(*errors), state(result), state(*grads))


CASES.add(
    "tfi",
    "gradient by the stated contract",
    limit=lambda dtype: 1.51 if dtype in HALVES else 2.0,
    bound="2 ulp, half 1.5: rate and product are rounded",
)(partial(_gradient, "tfi", {}))
CASES.add(
    "tfp", "gradient by the stated contract", limit=rounded_once(_FRAMES / 2), bound="half an ulp a frame, half 0.5"
)(partial(_gradient, "tfp", {"window": 11}))
