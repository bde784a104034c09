"""Extremes of the warps: on, near and far from known pixels, NaN flow, nearly empty masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

import spikekit as sk
from spikekit.extremes import reference
from spikekit.extremes.table import FLOATS, Cases, Measured, differ, outcome_of, rounded_once, state, ulps, worst

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


def _warp(
    features: Tensor, flow: Tensor, mask: Tensor | None, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the result of (C, H, W) and (2, H, W), and the gradients of its sum by both."""
    leaves = [tensor.to(device, dtype, copy=True).requires_grad_() for tensor in (features, flow)]
    result = sk.flow_warp(*leaves) if mask is None else sk.flow_warp_idw(*leaves, mask.to(device))
    by_features, by_flow = torch.autograd.grad(result.sum(), leaves)
    return result.detach().cpu(), by_features.cpu(), by_flow.cpu()


def _exact(
    features: Tensor, flow: Tensor, mask: Tensor, dtype: torch.dtype, columns: Sequence[int] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Result, its derivative by the flow, and the largest neighbour, for what the operator gets in its dtype."""
    got = flow.to(dtype).double().nan_to_num(nan=0.0, posinf=_FAR, neginf=-_FAR)
    arrays = reference.idw(features.to(dtype).double().numpy(), got.numpy(), mask.numpy(), columns=columns)
    return tuple(torch.from_numpy(array) for array in arrays)  # type: ignore[return-value]


def _values(flows: Sequence[Tensor], masks: Sequence[Tensor], dtype: torch.dtype, device: torch.device) -> Measured:
    """Values against the reference, all gradients finite."""
    errors, results, grads = [], [], []
    for flow in flows:
        for mask in masks:
            features = _draw(2, *mask.shape)
            result, *both = _warp(features, flow, mask, dtype, device)
            exact, _, largest = _exact(features, flow, mask, dtype)
            errors.append(ulps(result, exact, largest))
            results.append(result)
            grads += both
    return Measured(worst(*errors), state(*results), state(*grads))


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


@CASES.add(_OP, "zero flow: known pixels stay")
def _(dtype: torch.dtype, device: torch.device) -> Measured:
    error, results, grads = 0.0, [], []
    for mask in _MASKS.values():
        features = _draw(2, 6, 8).to(dtype)
        result, *both = _warp(features, torch.zeros(2, 6, 8), mask, dtype, device)
        error += differ(result[:, mask], features[:, mask])
        results.append(result)
        grads += both
    return Measured(error, state(*results), state(*grads))


def _close(distance: float, dtype: torch.dtype, device: torch.device) -> Measured:
    """Around every known pixel, in eight directions: the value is that of the pixel."""
    features, error, results, grads = _draw(2, 6, 8).to(dtype), 0.0, [], []
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 0.5), (-1, 0.5), (0.5, -1), (-0.5, -1)):
        flow = torch.tensor([x, y], dtype=torch.float64).reshape(2, 1, 1).expand(2, 6, 8) * distance
        for mask in _MASKS.values():
            result, *both = _warp(features, flow, mask, dtype, device)
            error += differ(result[:, mask], features[:, mask])
            results.append(result)
            grads += both
    return Measured(error, state(*results), state(*grads))


CASES.add(_OP, "1e-30 away from a known pixel")(partial(_close, 1e-30))
CASES.add(_OP, "1e-300 away from a known pixel", FLOATS[:1])(partial(_close, 1e-300))


@CASES.add(_OP, "flow NaN: the pixel stays")
def _(dtype: torch.dtype, device: torch.device) -> Measured:
    features, flow = _draw(2, 6, 8), _flows(2, 2**-9, 6, 8)
    lost = _draw(6, 8, seed=3) > 0
    broken, still, error = flow.clone(), flow.clone(), 0.0
    broken[0, lost] = _NAN
    broken[:, -1] = _NAN
    still[broken.isnan()] = 0
    results, grads = [], []
    for mask in _MASKS.values():
        result, by_features, by_flow = _warp(features, broken, mask, dtype, device)
        expected, expected_by_features, expected_by_flow = _warp(features, still, mask, dtype, device)
        expected_by_flow[broken.isnan()] = 0
        error += differ(result, expected) + differ(by_features, expected_by_features)
        error += differ(by_flow, expected_by_flow)
        results.append(result)
        grads += [by_features, by_flow]
    return Measured(error, state(*results), state(*grads))


@CASES.add(_OP, "flow Inf: very far", **_FEW)
def _(dtype: torch.dtype, device: torch.device) -> Measured:
    flows = []
    for x, y in ((_INF, 0), (-_INF, 0), (0, _INF), (0, -_INF), (_INF, -_INF), (-_INF, 1.5), (_INF, _NAN)):
        flows.append(torch.tensor([x, y], dtype=torch.float64).reshape(2, 1, 1).repeat(1, 6, 8))
    return _values(flows, list(_MASKS.values()), dtype, device)


@CASES.add(_OP, "flow Inf or NaN: no gradient by it")
def _(dtype: torch.dtype, device: torch.device) -> Measured:
    error, grads = 0.0, []
    for value in (_INF, -_INF, _NAN):
        for mask in _MASKS.values():
            flow = torch.full((2, 6, 8), value)
            *_, by_flow = _warp(_draw(2, 6, 8), flow, mask, dtype, device)
            error += differ(by_flow, torch.zeros(2, 6, 8))
            grads.append(by_flow)
    return Measured(error, "finite", state(*grads))


@CASES.add(_OP, "1 known pixel: that one everywhere")
def _(dtype: torch.dtype, device: torch.device) -> Measured:
    error, results, grads = 0.0, [], []
    mask, features = _some(6, 8, 1), _draw(2, 6, 8).to(dtype)
    for flow in (_flows(2, 2**-9, 6, 8), _flows(1e4, 1, 6, 8), torch.full((2, 6, 8), _INF), torch.zeros(2, 6, 8)):
        result, by_features, by_flow = _warp(features, flow, mask, dtype, device)
        error += differ(result, features[:, mask].reshape(2, 1, 1).expand(2, 6, 8))
        error += differ(by_flow, torch.zeros_like(by_flow)) + differ(by_features, mask * 48.0 + torch.zeros(2, 1, 1))
        results.append(result)
        grads += [by_features, by_flow]
    return Measured(error, state(*results), state(*grads))


def _none_known(dtype: torch.dtype, device: torch.device) -> Measured:
    features, flow = torch.zeros(1, 4, 4, dtype=dtype, device=device), torch.zeros(2, 4, 4, dtype=dtype, device=device)
    return outcome_of(ValueError, lambda: sk.flow_warp_idw(features, flow, torch.zeros(4, 4, device=device)))


CASES.add(_OP, "no known pixel", bound="an error", values="ValueError", gradients="-")(_none_known)


@CASES.add(_OP, "NaN at unknown pixels is not read")
def _(dtype: torch.dtype, device: torch.device) -> Measured:
    error, results, grads = 0.0, [], []
    for mask in (_green(6, 8), _some(6, 8, 16), _some(6, 8, 2)):
        features, flow = _draw(2, 6, 8), _flows(2, 2**-9, 6, 8)
        clean, broken = (_warp(f, flow, mask, dtype, device) for f in (features, features.masked_fill(~mask, _NAN)))
        error += sum(differ(one, other) for one, other in zip(broken, clean, strict=True))
        results.append(broken[0])
        grads += broken[1:]
    return Measured(error, state(*results), state(*grads))


_WIDE = 4104


def _far_right(op: str, dtype: torch.dtype, device: torch.device) -> Measured:
    """Columns that float16 cannot count: beyond 2048 it holds even numbers only, beyond 4096 every fourth."""
    features, flow = _draw(1, 2, _WIDE), _flows(2, 2**-6, 2, _WIDE)
    mask = _green(2, _WIDE) if op == _OP else None
    columns = [*range(2040, 2056), *range(_WIDE - 16, _WIDE)]
    result, *grads = _warp(features, flow, mask, dtype, device)
    if mask is None:
        exact, largest = _bilinear(features, flow, dtype, columns)
    else:
        exact, _, largest = _exact(features, flow, mask, dtype, columns)
    return Measured(ulps(result[..., columns], exact, largest), state(result), state(*grads))


CASES.add(_OP, "columns 2040 to 4104", **_FEW)(partial(_far_right, _OP))


@CASES.add(_OP, "gradient on a known pixel is 0")
def _(dtype: torch.dtype, device: torch.device) -> Measured:
    error, grads = 0.0, []
    for mask in _MASKS.values():
        *_, by_flow = _warp(_draw(2, 6, 8), torch.zeros(2, 6, 8), mask, dtype, device)
        error += differ(by_flow[:, mask], torch.zeros(2, int(mask.sum())))
        grads.append(by_flow)
    return Measured(error, "finite", state(*grads))


def _slopes(flows: Sequence[Tensor], at_known: bool, dtype: torch.dtype, device: torch.device) -> Measured:
    """Gradient by the flow, in ulp of the steepest descent, or of 1 where it is flatter."""
    errors, grads = [], []
    for flow in flows:
        for mask in _MASKS.values():
            features = _draw(1, 6, 8)
            *_, by_flow = _warp(features, flow, mask, dtype, device)
            _, slope, _ = _exact(features, flow, mask, dtype)
            steepest = slope[0].norm(dim=0, keepdim=True).clamp(min=1).expand(2, 6, 8)
            here = mask if at_known else torch.ones_like(mask)
            errors.append(ulps(by_flow[:, here], slope[0][:, here], steepest[:, here]))
            grads.append(by_flow)
    return Measured(worst(*errors), "finite", state(*grads))


_STEEP: dict[str, Any] = {"limit": rounded_once(8), "bound": "8 ulp of the slope, half 0.5"}
CASES.add(_OP, "gradient by the flow: anywhere", **_STEEP)(partial(_slopes, [_flows(2, 2**-9, 6, 8)], False))
CASES.add(_OP, "gradient by the flow: at ties", **_STEEP)(
    partial(_slopes, [_flows(2, 0.5, 6, 8), _flows(2, 1, 6, 8), torch.zeros(2, 6, 8)], False)
)
CASES.add(_OP, "gradient by the flow: 1e-2 to 1e-15 from a known pixel", **_STEEP)(
    partial(
        _slopes,
        [
            torch.tensor([x, y]).reshape(2, 1, 1).expand(2, 6, 8).double() * 10.0**-exponent
            for exponent in (2, 4, 7, 11, 15)
            for x, y in ((1, 0.5), (-0.75, 0.5), (0.25, -1), (-1, -1))
        ],
        True,
    )
)


def _by_table(take: Callable[[Tensor], Tensor], dtype: torch.dtype, device: torch.device) -> Measured:
    """Noise in [0, 1], at positions within the image; an error of 1 is the range of the features."""
    features, flow = (
        torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).to(dtype).to(device)
        for shape in ((4, 1, 32, 32), (4, 2, 32, 32))
    )
    leaves = [features.requires_grad_(), (8 * flow.detach() - 4).requires_grad_()]
    errors, grads = [], []
    for mask in sk.bayer_mask(16, 16, scale=2, device=device):
        result = sk.flow_warp_idw(*leaves, mask, steps=16)
        grads += torch.autograd.grad(result.sum(), leaves)
        errors.append(float(take((result - sk.flow_warp_idw(*leaves, mask))[..., 4:-4, 4:-4].detach().double().abs())))
    return Measured(worst(*errors), "finite", state(*grads))


CASES.add(_OP, "steps=16, worst error", limit=0.75, bound="3/4 of the range: the nearest pixel stays")(
    partial(_by_table, lambda error: error.max())
)
CASES.add(_OP, "steps=16, root of the mean square", limit=0.1, bound="1/10 of the range")(
    partial(_by_table, lambda error: error.square().mean().sqrt())
)


def _bilinear(
    image: Tensor, flow: Tensor, dtype: torch.dtype, columns: Sequence[int] | None = None
) -> tuple[Tensor, Tensor]:
    got = flow.to(dtype).double().nan_to_num(nan=0.0, posinf=_FAR, neginf=-_FAR)
    image = image.to(dtype).double()
    exact = torch.from_numpy(reference.bilinear(image.numpy(), got.numpy(), columns))
    return exact, image.abs().amax(dim=(1, 2), keepdim=True).expand_as(exact)


def _bilinear_values(flows: Sequence[Tensor], dtype: torch.dtype, device: torch.device) -> Measured:
    errors, results, grads = [], [], []
    for flow in flows:
        image = _draw(2, *flow.shape[1:])
        result, *both = _warp(image, flow, None, dtype, device)
        errors.append(ulps(result, *_bilinear(image, flow, dtype)))
        results.append(result)
        grads += both
    return Measured(worst(*errors), state(*results), state(*grads))


for _extreme, _shifts in {
    "zero flow": [torch.zeros(2, 6, 8)],
    "flow of any length": [_flows(2, 2**-9, 6, 8)],
    "flow of whole and half pixels": [_flows(2, 1, 6, 8), _flows(2, 0.5, 6, 8)],
    "1e-30 away from a pixel": [torch.full((2, 6, 8), 1e-30), torch.full((2, 6, 8), -1e-30)],
    "flow of 1e4 pixels": [_flows(1e4, 2**-6, 6, 8)],
    "flow NaN: the pixel stays": [torch.full((2, 6, 8), _NAN)],
    "flow Inf: the border": [torch.full((2, 6, 8), _INF), torch.full((2, 6, 8), -_INF)],
    "1 x 1, 1 x W, H x 1, odd size": [_flows(2, 2**-9, *_size) for _size in ((1, 1), (1, 9), (9, 1), (5, 7))],
}.items():
    CASES.add("flow_warp", _extreme, limit=rounded_once(16), bound="2 ulp of the position, half 0.5")(
        partial(_bilinear_values, _shifts)
    )
CASES.add("flow_warp", "columns 2040 to 4104", limit=rounded_once(2 * _WIDE), bound="2 ulp of the position, half 0.5")(
    partial(_far_right, "flow_warp")
)
