"""Light between two neighbouring frames of a film, modelled as its plan says."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from spikekit.scenes.adaptive_sampling import Plan, Region, SceneProfile


class Interval:
    """Two neighbouring frames and the light between them, computed on demand, by the settings of their film."""

    def __init__(self, film: Any, first: Tensor, second: Tensor) -> None:
        self.film, self.frames = film, (first, second)
        self._betweens: dict[Region | None, Any] = {}
        self._latent: dict[int, Tensor] = {}

    @cached_property
    def profile(self) -> SceneProfile:
        """Change within the interval."""
        return self.film._profile(*self.frames)

    @cached_property
    def plan(self) -> Plan:
        """Moments that are modelled."""
        film = self.film
        return film.fixed or self.profile.plan(spike_tolerance=film.spike_tolerance, step=film.step)

    @cached_property
    def _ends(self) -> tuple[Tensor, ...]:
        return tuple(map(self.film._seen, self.frames))

    def between(self, region: Region | None = None) -> Any:
        """Return the interpolation for a region of the sensor, or for all of it when not given."""
        if region not in self._betweens:
            ends = self.frames
            if region is not None:
                top, left, height, width = (self.film.scale * pixels for pixels in region)
                ends = tuple(frame[:, top : top + height, left : left + width].contiguous() for frame in ends)
            self._betweens[region] = self.film.interpolation(*ends)
        return self._betweens[region]

    def light(self, phase: int) -> Tensor:
        """Return the light at a clock of the interval, 1 to ``clocks - 1``."""
        steps, region, clocks = self.plan.latent + 1, self.plan.region, self.film.clocks
        blended = torch.lerp(*self._ends, phase / clocks)
        if steps == 1:
            return blended
        before, rest = divmod(phase * steps, clocks)
        part = self._at(before, steps)
        if rest:
            part = torch.lerp(part, self._at(before + 1, steps), rest / clocks)
        if region is None:
            return part
        top, left, height, width = region
        blended[top : top + height, left : left + width] = part
        return blended

    def _at(self, number: int, steps: int) -> Tensor:
        """Return the light of latent frame ``number`` in the plan's region; 0 and ``steps`` are the ends."""
        if number not in self._latent:
            self._latent[number] = self.film._seen(self.between(self.plan.region).at(number / steps))
        return self._latent[number]
