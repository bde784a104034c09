"""Light between two neighbouring frames of a film, modelled as its plan says."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from spikekit.scenes.adaptive_sampling import Plan, Region, SceneProfile


class Interval:
    """Two neighbouring frames and what lies between them; nothing is computed before it is asked for.

    Args:
        first: ``rgb`` (3, H, W), its sides multiples of ``2 * scale``.
        second: the next frame.
        clocks: clocks from one to the other.
        scale: how many pixels a sensor pixel is wide.
        seen: gives the sensor's light of a picture.
        interpolation: makes what lies between two pictures.
        profile: looks at two frames.
        plan: makes a plan of a profile.
        fixed: the plan, where there is one already.
    """

    def __init__(
        self,
        first: Tensor,
        second: Tensor,
        clocks: int,
        scale: int,
        seen: Callable[[Tensor], Tensor],
        interpolation: Callable[[Tensor, Tensor], Any],
        profile: Callable[[Tensor, Tensor], SceneProfile],
        plan: Callable[[SceneProfile], Plan],
        fixed: Plan | None = None,
    ) -> None:
        self.frames = first, second
        self.clocks, self.scale = clocks, scale
        self._seen, self._interpolation, self._look, self._decide = seen, interpolation, profile, plan
        self._fixed = fixed
        self._betweens: dict[Region | None, Any] = {}
        self._latent: dict[int, Tensor] = {}

    @cached_property
    def profile(self) -> SceneProfile:
        """Change within the interval."""
        return self._look(*self.frames)

    @cached_property
    def plan(self) -> Plan:
        """Moments that are modelled."""
        return self._fixed or self._decide(self.profile)

    @cached_property
    def _ends(self) -> tuple[Tensor, ...]:
        return tuple(self._seen(frame) for frame in self.frames)

    def between(self, region: Region | None = None) -> Any:
        """Return what the interpolation makes of a region of the sensor; of all of it when not given."""
        if region not in self._betweens:
            ends = self.frames
            if region is not None:
                top, left, height, width = (self.scale * pixels for pixels in region)
                ends = tuple(frame[:, top : top + height, left : left + width].contiguous() for frame in ends)
            self._betweens[region] = self._interpolation(*ends)
        return self._betweens[region]

    def light(self, phase: int) -> Tensor:
        """Return the light at a clock of the interval, 1 to ``clocks - 1``."""
        steps, region = self.plan.latent + 1, self.plan.region
        blended = torch.lerp(*self._ends, phase / self.clocks)
        if steps == 1:
            return blended
        before, rest = divmod(phase * steps, self.clocks)
        part = self._at(before, steps)
        if rest:
            part = torch.lerp(part, self._at(before + 1, steps), rest / self.clocks)
        if region is None:
            return part
        top, left, height, width = region
        blended[top : top + height, left : left + width] = part
        return blended

    def _at(self, number: int, steps: int) -> Tensor:
        """Return the light of latent frame ``number`` in the plan's region; 0 and ``steps`` are the ends."""
        if number not in self._latent:
            self._latent[number] = self._seen(self.between(self.plan.region).at(number / steps))
        return self._latent[number]
