"""Every operator with an example of its input, for what must hold of all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import spikekit as sk


@dataclass(frozen=True)
class Operator:
    """An operator and how to call it.

    Attributes:
        name: of the public function.
        call: with tensors, and whatever else it needs.
        inputs: makes the tensors, given their leading dimensions, (H, W), and a generator.
        axis_in: of the tensors' first leading dimension.
        axis_out: the same of the results.
        smooth: how often its result can be differentiated by finite differences: 0 with a surrogate gradient.
    """

    name: str
    call: Callable[..., Any]
    inputs: Callable[[tuple[int, ...], tuple[int, int], torch.Generator], tuple[Tensor, ...]]
    axis_in: int = 0
    axis_out: int = 0
    smooth: int = 2

    def results(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Call it; a tuple also of one result."""
        results = self.call(*tensors)
        return results if isinstance(results, tuple) else (results,)

    def example(self, lead: tuple[int, ...], size: tuple[int, int] = (4, 6), seed: int = 0) -> tuple[Tensor, ...]:
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


def _idw(features: Tensor, flow: Tensor) -> Tensor:
    mask = sk.bayer_mask(features.shape[-2], features.shape[-1], device=features.device)[1]
    return sk.flow_warp_idw(features, flow, mask)


OPERATORS = [
    Operator("spike_integrate_fire", lambda light: sk.spike_integrate_fire(light, 0.75), _light, smooth=0),
    Operator("spike_interval", lambda spikes: sk.spike_interval(spikes), _spikes, smooth=0),
    Operator("tfi", lambda spikes: sk.tfi(spikes, 2.0), _spikes, smooth=0),
    Operator("tfp", lambda spikes: sk.tfp(spikes, 5, 2.0), _spikes),
    Operator("flow_warp", lambda image, flow: sk.flow_warp(image, flow), _image_and_flow),
    Operator("flow_warp_idw", _idw, _image_and_flow),
    Operator("mosaic", lambda rgb: sk.mosaic(rgb, "GRBG"), _rgb),
    Operator("bin_to_sensor", lambda rgb: sk.bin_to_sensor(rgb, "GRBG", scale=2), _rgb),
    Operator("split_colors", lambda raw: sk.split_colors(raw, "GRBG"), _raw, axis_out=1),
    Operator("split_bayer", lambda raw: sk.split_bayer(raw, "GRBG"), _raw, axis_out=1),
    Operator("merge_bayer", lambda planes: sk.merge_bayer(planes, "GRBG"), _planes, axis_in=1),
    Operator("demosaic", lambda raw: sk.demosaic(raw, "GRBG"), _raw),
    Operator("joint_flow", lambda flows: sk.joint_flow(flows), _four_flows, axis_in=1),
    Operator("upsample_flow", lambda flow: sk.upsample_flow(flow, 3), _flow),
    Operator("linear_motion", lambda *flows: sk.linear_motion(*flows, [0.0, 2.0, 5.0], scale=2), _two_flows),
]
