"""Extremes of the warps: on, near and far from known pixels, NaN flow, nearly empty masks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any

import brute_force
import torch
from torch import Tensor

import spikekit as sk
from extremes.table import (
    FLOATS,
    Cases,
    Measured,
    On,
    apart,
    differ,
    measured,
    outcome_of,
    rounded_once,
    sums_on_gpu,
    ulps,
)

CASES = Cases()

_OP = "flow_warp_idw"
_INF, _NAN = float("inf"), float("nan")
_FAR = 2.0**30  # where infinite flow points to


def _draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def _green(height: int, width: int) -> Tensor:
    return sk.bayer_mask(height, width, dtype=torch.bool)[1]


def _some(height: int, width: int, known: int) -> Tensor:
    """Return a mask without a period, of so many known pixels."""
    order = torch.randperm(height * width, generator=torch.Generator().manual_seed(known))
    return (order < known).reshape(height, width)


_MASKS = {"green": _green(6, 8), "a third": _some(6, 8, 16), "all": torch.ones(6, 8, dtype=torch.bool)}


def _warp(features: Tensor, flow: Tensor, mask: Tensor | None, on: On) -> tuple[Tensor, Tensor, Tensor]:
    """Return the result of (C, H, W) and (2, H, W), and the gradients of its sum by both."""
    leaves = [tensor.to(on.device, on.dtype, copy=True).requires_grad_() for tensor in (features, flow)]
    result = sk.flow_warp(*leaves) if mask is None else sk.flow_warp_idw(*leaves, mask.to(on.device))
    by_features, by_flow = torch.autograd.grad(result.sum(), leaves)
    return result.detach().cpu(), by_features.cpu(), by_flow.cpu()


def _exact(
    features: Tensor, flow: Tensor, mask: Tensor, dtype: torch.dtype, columns: Sequence[int] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Result, its derivative by the flow, and the largest neighbour, for what the operator gets in its dtype."""
    got = flow.to(dtype).double().nan_to_num(nan=0.0, posinf=_FAR, neginf=-_FAR)
    arrays = brute_force.idw(features.to(dtype).double().numpy(), got.numpy(), mask.numpy(), columns=columns)
    return tuple(torch.from_numpy(array) for array in arrays)  # type: ignore[return-value]


def _values(flows: Sequence[Tensor], masks: Sequence[Tensor], on: On) -> Iterator[Measured]:
    """Values against the reference, all gradients finite."""
    for flow, mask in product(flows, masks):
        features = _draw(2, *mask.shape)
        result, *grads = _warp(features, flow, mask, on)
        exact, _, largest = _exact(features, flow, mask, on.dtype)
        yield measured(ulps(result, exact, largest), result, grads)


_FEW: dict[str, Any] = {"limit": rounded_once(4), "bound": "4 ulp of the largest neighbour, half 0.5"}


def _flows(scale: float, unit: float, *size: int) -> Tensor:
    """Multiples of ``unit``, about ``scale`` long."""
    return torch.round(_draw(2, *size, seed=1) * scale / unit) * unit


for _extreme, _flow in {
    "flow of any length": _flows(2, 2**-9, 6, 8),
    "flow of whole pixels: hits and ties": _flows(2, 1, 6, 8),
    "flow of half pixels: ties": _flows(2, 0.5, 6, 8),
    "flow of 1e4 pixels": _flows(1e4, 2**-6, 6, 8),
    "flow of 1e4 pixels along one axis": _flows(2, 1, 6, 8) + torch.tensor([1e4, 0.0]).reshape(2, 1, 1),
}.items():
    CASES.add(_OP, _extreme, **_FEW)(partial(_values, [_flow], list(_MASKS.values())))

for _extreme, _mask in {
    "3 known pixels": _some(5, 7, 3),
    "2 known pixels": _some(5, 7, 2),
    "1 x 1": _some(1, 1, 1),
    "1 x W": _some(1, 9, 5),
    "H x 1": _some(9, 1, 5),
    "odd size": _green(5, 7),
}.items():
    CASES.add(_OP, _extreme, **_FEW)(
        partial(_values, [_flows(2, 2**-9, *_mask.shape), _flows(1e3, 1, *_mask.shape)], [_mask])
    )


def _uniform(x: float, y: float) -> Tensor:
    """The same flow everywhere."""
    return torch.tensor([x, y], dtype=torch.float64).reshape(2, 1, 1).repeat(1, 6, 8)


_AROUND = [_uniform(x, y) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 0.5), (-1, 0.5), (0.5, -1), (-0.5, -1))]
_STILL = torch.zeros(2, 6, 8)


def _stay(flows: Sequence[Tensor], on: On) -> Iterator[Measured]:
    """On every known pixel the value is that of the pixel."""
    features = _draw(2, 6, 8).to(on.dtype)
    for flow, mask in product(flows, _MASKS.values()):
        result, *grads = _warp(features, flow, mask, on)
        yield measured(differ(result[:, mask], features[:, mask]), result, grads)


CASES.add(_OP, "zero flow: known pixels stay")(partial(_stay, [_STILL]))
CASES.add(_OP, "1e-30 away from a known pixel")(partial(_stay, [flow * 1e-30 for flow in _AROUND]))
CASES.add(_OP, "1e-300 away from a known pixel", FLOATS[:1])(partial(_stay, [flow * 1e-300 for flow in _AROUND]))


@CASES.add(_OP, "flow NaN: the pixel stays")
def _(on: On) -> Iterator[Measured]:
    features, flow = _draw(2, 6, 8), _flows(2, 2**-9, 6, 8)
    lost = _draw(6, 8, seed=3) > 0
    broken, still = flow.clone(), flow.clone()
    broken[0, lost] = _NAN
    broken[:, -1] = _NAN
    still[broken.isnan()] = 0
    for mask in _MASKS.values():
        found, expected = (_warp(features, each, mask, on) for each in (broken, still))
        expected[2][broken.isnan()] = 0
        yield measured(sum(map(differ, found, expected)), found[0], found[1:])


_INFINITE = ((_INF, 0), (-_INF, 0), (0, _INF), (0, -_INF), (_INF, -_INF), (-_INF, 1.5), (_INF, _NAN))
CASES.add(_OP, "flow Inf: very far", **_FEW)(
    partial(_values, [_uniform(*far) for far in _INFINITE], list(_MASKS.values()))
)


@CASES.add(_OP, "flow Inf or NaN: no gradient by it")
def _(on: On) -> Iterator[Measured]:
    for value, mask in product((_INF, -_INF, _NAN), _MASKS.values()):
        *_, by_flow = _warp(_draw(2, 6, 8), torch.full((2, 6, 8), value), mask, on)
        yield measured(differ(by_flow, _STILL), (), by_flow)


@CASES.add(_OP, "1 known pixel: that one everywhere")
def _(on: On) -> Iterator[Measured]:
    mask, features = _some(6, 8, 1), _draw(2, 6, 8).to(on.dtype)
    expected = features[:, mask].reshape(2, 1, 1).expand(2, 6, 8), mask * 48.0 + torch.zeros(2, 1, 1), _STILL
    for flow in (_flows(2, 2**-9, 6, 8), _flows(1e4, 1, 6, 8), torch.full((2, 6, 8), _INF), _STILL):
        found = _warp(features, flow, mask, on)
        yield measured(sum(map(differ, found, expected)), found[0], found[1:])


def _none_known(on: On) -> Measured:
    features, flow = (torch.zeros(n, 4, 4, dtype=on.dtype, device=on.device) for n in (1, 2))
    return outcome_of(ValueError, lambda: sk.flow_warp_idw(features, flow, torch.zeros(4, 4, device=on.device)))


CASES.add(_OP, "no known pixel", bound="an error", values="ValueError", gradients="-")(_none_known)


@CASES.add(_OP, "NaN at unknown pixels is not read", on_gpu=sums_on_gpu(_OP))
def _(on: On) -> Iterator[Measured]:
    features, flow = _draw(2, 6, 8), _flows(2, 2**-9, 6, 8)
    for mask in (_green(6, 8), _some(6, 8, 16), _some(6, 8, 2)):
        clean, broken = (_warp(f, flow, mask, on) for f in (features, features.masked_fill(~mask, _NAN)))
        pairs = list(zip(broken, clean, strict=True))
        yield measured(apart(pairs[:1], pairs[1:], on.device), broken[0], broken[1:])


_WIDE = 4104


def _far_right(op: str, on: On) -> Measured:
    """Columns that float16 cannot count: beyond 2048 it holds even numbers only, beyond 4096 every fourth."""
    features, flow = _draw(1, 2, _WIDE), _flows(2, 2**-6, 2, _WIDE)
    mask = _green(2, _WIDE) if op == _OP else None
    columns = [*range(2040, 2056), *range(_WIDE - 16, _WIDE)]
    result, *grads = _warp(features, flow, mask, on)
    if mask is None:
        exact, largest = _bilinear(features, flow, on.dtype, columns)
    else:
        exact, _, largest = _exact(features, flow, mask, on.dtype, columns)
    return measured(ulps(result[..., columns], exact, largest), result, grads)


CASES.add(_OP, "columns 2040 to 4104", **_FEW)(partial(_far_right, _OP))


@CASES.add(_OP, "gradient on a known pixel is 0")
def _(on: On) -> Iterator[Measured]:
    for mask in _MASKS.values():
        *_, by_flow = _warp(_draw(2, 6, 8), _STILL, mask, on)
        yield measured(differ(by_flow[:, mask], _STILL[:, mask]), (), by_flow)


def _slopes(flows: Sequence[Tensor], at_known: bool, on: On) -> Iterator[Measured]:
    """Gradient by the flow, in ulp of the steepest descent, or of 1 where it is flatter."""
    features = _draw(1, 6, 8)
    for flow, mask in product(flows, _MASKS.values()):
        *_, by_flow = _warp(features, flow, mask, on)
        _, slope, _ = _exact(features, flow, mask, on.dtype)
        steepest = slope[0].norm(dim=0, keepdim=True).clamp(min=1).expand(2, 6, 8)
        here = mask if at_known else torch.ones_like(mask)
        yield measured(ulps(by_flow[:, here], slope[0][:, here], steepest[:, here]), (), by_flow)


_STEEP: dict[str, Any] = {"limit": rounded_once(8), "bound": "8 ulp of the slope, half 0.5"}
_SLANTS = ((1, 0.5), (-0.75, 0.5), (0.25, -1), (-1, -1))
_NEAR = [_uniform(*slant) * 10.0**-exponent for exponent in (2, 4, 7, 11, 15) for slant in _SLANTS]
for _extreme, _steep, _at_known in (
    ("anywhere", [_flows(2, 2**-9, 6, 8)], False),
    ("at ties", [_flows(2, 0.5, 6, 8), _flows(2, 1, 6, 8), _STILL], False),
    ("1e-2 to 1e-15 from a known pixel", _NEAR, True),
):
    CASES.add(_OP, f"gradient by the flow: {_extreme}", **_STEEP)(partial(_slopes, _steep, _at_known))


def _bilinear(
    image: Tensor, flow: Tensor, dtype: torch.dtype, columns: Sequence[int] | None = None
) -> tuple[Tensor, Tensor]:
    got = flow.to(dtype).double().nan_to_num(nan=0.0, posinf=_FAR, neginf=-_FAR)
    image = image.to(dtype).double()
    exact = torch.from_numpy(brute_force.bilinear(image.numpy(), got.numpy(), columns))
    return exact, image.abs().amax(dim=(1, 2), keepdim=True).expand_as(exact)


def _bilinear_values(flows: Sequence[Tensor], on: On) -> Iterator[Measured]:
    for flow in flows:
        image = _draw(2, *flow.shape[1:])
        result, *grads = _warp(image, flow, None, on)
        yield measured(ulps(result, *_bilinear(image, flow, on.dtype)), result, grads)


_OF_THE_POSITION = "2 ulp of the position, half 0.5"
for _extreme, _shifts in {
    "zero flow": [_STILL],
    "flow of any length": [_flows(2, 2**-9, 6, 8)],
    "flow of whole and half pixels": [_flows(2, 1, 6, 8), _flows(2, 0.5, 6, 8)],
    "1e-30 away from a pixel": [torch.full((2, 6, 8), 1e-30), torch.full((2, 6, 8), -1e-30)],
    "flow of 1e4 pixels": [_flows(1e4, 2**-6, 6, 8)],
    "flow NaN: the pixel stays": [torch.full((2, 6, 8), _NAN)],
    "flow Inf: the border": [torch.full((2, 6, 8), _INF), torch.full((2, 6, 8), -_INF)],
    "1 x 1, 1 x W, H x 1, odd size": [_flows(2, 2**-9, *_size) for _size in ((1, 1), (1, 9), (9, 1), (5, 7))],
}.items():
    CASES.add("flow_warp", _extreme, limit=rounded_once(16), bound=_OF_THE_POSITION)(partial(_bilinear_values, _shifts))
CASES.add("flow_warp", "columns 2040 to 4104", limit=rounded_once(2 * _WIDE), bound=_OF_THE_POSITION)(
    partial(_far_right, "flow_warp")
)
