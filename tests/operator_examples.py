"""The operators, each with example arguments: the list that tests of what holds for every operator go through."""

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
        inputs: what the tensors are.
        options: the other arguments, of the function and of the module's constructor.
        constants: makes tensors without leading dimensions, which follow the others, from the first of these.
        axis_in: of the tensors' first leading dimension.
        axis_out: the same of the results.
        smooth: how often its result can be differentiated by finite differences: 0 with a surrogate gradient.
    """

    name: str
    inputs: tuple[str, ...]
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
        rng = torch.Generator().manual_seed(seed)
        return tuple(_draw(name, lead, size, rng) for name in self.inputs)


# What inputs are called, and their sizes around the leading dimensions and before (H, W).
_SIZES: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "light": ((), (9,)),
    "spikes": ((), (9,)),
    "rgb": ((), (3,)),
    "raw": ((), ()),
    "planes": ((4,), ()),
    "flow": ((), (2,)),
    "four flows": ((4,), (2,)),
    "three mosaics": ((), (3,)),
    "flow to three": ((), (3, 2)),
}


def _draw(name: str, lead: tuple[int, ...], size: tuple[int, int], rng: torch.Generator) -> Tensor:
    before, behind = _SIZES[name]
    uniform = torch.rand((*before, *lead, *behind, *size), dtype=torch.float64, generator=rng)
    if name == "spikes":
        return (uniform < 0.4).double()
    return 4 * uniform - 2 if "flow" in name else uniform


def _green(features: Tensor) -> tuple[Tensor, ...]:
    return (sk.bayer_mask(*features.shape[-2:], device=features.device, dtype=features.dtype)[1],)


_TIMES = {"times": (0.0, 2.0, 5.0), "first": -1, "middle": 2, "last": 6, "scale": 2}
_GRBG = {"pattern": "GRBG"}
EXAMPLES = [
    Example("spike_integrate_fire", ("light",), {"threshold": 0.75}, smooth=0),
    Example("spike_interval", ("spikes",), smooth=0),
    Example("tfi", ("spikes",), {"max_range": 2.0}, smooth=0),
    Example("tfp", ("spikes",), {"window": 5, "max_range": 2.0}),
    Example("flow_warp", ("rgb", "flow")),
    Example("flow_warp_idw", ("rgb", "flow"), {"neighbors": 3}, _green),
    Example("mosaic", ("rgb",), _GRBG),
    Example("bin_to_sensor", ("rgb",), {**_GRBG, "scale": 2}),
    Example("split_colors", ("raw",), _GRBG, axis_out=1),
    Example("split_bayer", ("raw",), _GRBG, axis_out=1),
    Example("merge_bayer", ("planes",), _GRBG, axis_in=1),
    Example("demosaic", ("raw",), _GRBG),
    Example("demosaic_residual", ("raw",), _GRBG),
    Example("demosaic_along_motion", ("three mosaics", "flow to three"), _GRBG),
    Example("joint_flow", ("four flows",), axis_in=1),
    Example("upsample_flow", ("flow",), {"scale": 3}),
    Example("linear_motion", ("flow", "flow"), _TIMES),
]
