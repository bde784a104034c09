"""The operators with example arguments, for tests, extremes and the benchmark."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

import spikekit as sk


@dataclass(frozen=True)
class Example:
    """An operator, how its module is called, and what both are called with.

    Attributes:
        name: of the public function; the module has the same in CamelCase.
        inputs: makes the tensors, given their leading dimensions, (H, W), and a generator.
        options: the other arguments, of the function and of the module's constructor.
        constants: makes tensors without leading dimensions, which follow the others, from the first of these.
        axis_in: of the tensors' first leading dimension.
        axis_out: the same of the results.
        smooth: how often its result can be differentiated by finite differences: 0 with a surrogate gradient.
    """

    name: str
    inputs: Callable[[tuple[int, ...], tuple[int, int], torch.Generator], tuple[Tensor, ...]]
    options: dict[str, Any] = field(default_factory=dict)
    constants: Callable[[Tensor], tuple[Tensor, ...]] = lambda _: ()
    axis_in: int = 0
    axis_out: int = 0
    smooth: int = 2

    def call(self, *tensors: Tensor) -> Any:
        """Call the function, which is looked up only now, with tensors as :meth:`tensors` makes them."""
        return getattr(sk, self.name)(*tensors, *self.constants(tensors[0]), **self.options)

    def module(self) -> nn.Module:
        """Return the module."""
        return getattr(sk, re.sub(r"(?:^|_)([a-z])", lambda letter: letter[1].upper(), self.name))(**self.options)

    def results(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Call it; a tuple also of one result."""
        results = self.call(*tensors)
        return results if isinstance(results, tuple) else (results,)

    def tensors(self, lead: tuple[int, ...], size: tuple[int, int] = (4, 6), seed: int = 0) -> tuple[Tensor, ...]:
        """Return inputs of float64, always the same."""
        return self.inputs(lead, size, torch.Generator().manual_seed(seed))


def _random(*shape: int, rng: torch.Generator) -> Tensor:
    return torch.rand(shape, dtype=torch.float64, generator=rng)


def _light(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return (_random(*lead, 9, *size, rng=rng),)


def _spikes(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return ((_random(*lead, 9, *size, rng=rng) < 0.4).double(),)


def _rgb(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return (_random(*lead, 3, *size, rng=rng),)


def _raw(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return (_random(*lead, *size, rng=rng),)


def _planes(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return (_random(4, *lead, *size, rng=rng),)


def _flow(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return (4 * _random(*lead, 2, *size, rng=rng) - 2,)


def _two_flows(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return (*_flow(lead, size, rng), *_flow(lead, size, rng))


def _four_flows(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return _flow((4, *lead), size, rng)


def _image_and_flow(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return (*_rgb(lead, size, rng), *_flow(lead, size, rng))


def _mosaics_and_flow(lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> tuple[Tensor, ...]:
    return _random(*lead, 3, *size, rng=rng), *_flow((*lead, 3), size, rng)


def _green(features: Tensor) -> tuple[Tensor, ...]:
    return (sk.bayer_mask(*features.shape[-2:], device=features.device, dtype=features.dtype)[1],)


_TIMES = {"times": (0.0, 2.0, 5.0), "first": -1, "middle": 2, "last": 6, "scale": 2}
_GRBG = {"pattern": "GRBG"}
EXAMPLES = [
    Example("spike_integrate_fire", _light, {"threshold": 0.75}, smooth=0),
    Example("spike_interval", _spikes, smooth=0),
    Example("tfi", _spikes, {"max_range": 2.0}, smooth=0),
    Example("tfp", _spikes, {"window": 5, "max_range": 2.0}),
    Example("flow_warp", _image_and_flow),
    Example("flow_warp_idw", _image_and_flow, {"neighbors": 3}, _green),
    Example("mosaic", _rgb, _GRBG),
    Example("bin_to_sensor", _rgb, {**_GRBG, "scale": 2}),
    Example("split_colors", _raw, _GRBG, axis_out=1),
    Example("split_bayer", _raw, _GRBG, axis_out=1),
    Example("merge_bayer", _planes, _GRBG, axis_in=1),
    Example("demosaic", _raw, _GRBG),
    Example("demosaic_residual", _raw, _GRBG),
    Example("demosaic_along_motion", _mosaics_and_flow, _GRBG),
    Example("joint_flow", _four_flows, axis_in=1),
    Example("upsample_flow", _flow, {"scale": 3}),
    Example("linear_motion", _two_flows, _TIMES),
]
