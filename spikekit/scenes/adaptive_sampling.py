"""Adaptive sampling of films: profile the motion, and plan the number of latent frames it requires."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import Pattern, bin_to_sensor, mosaic
from spikekit.flow.fields import upsample_flow
from spikekit.flow.interpolate import FlowInterpolation
from spikekit.warp.warp import flow_warp

#: A rectangle of the sensor: first row, first column, rows, columns.
Region = tuple[int, int, int, int]

# Margin around moving pixels, in sensor pixels, in addition to the displacement; flow estimation needs context.
_MARGIN = 8

# Largest forward-backward error of consistent flow: this many sensor pixels, plus as many per pixel of displacement.
_CONSISTENT = 0.1

# If flow is consistent for a smaller share of the moving pixels, motion estimation has failed.
_FEW = 0.1

_NEARLY_ALL = 0.75  # larger regions, as a share of the sensor, are not cut out

_FINE = 1e-6  # shorter displacements have no direction

# Safety factor of the estimated spike changes: curvature at the sensor's resolution misses finer detail, and for coarse
# detail with large displacements errors accumulate over more than one pixel.
_SAFETY = 4

_BLACK = 1e-3  # added to numerator and denominator of a gain


@dataclass(frozen=True)
class Plan:
    """Latent frames of an interval between two frames; light is blended linearly in time between them.

    Args:
        latent: number of latent frames, evenly spaced; with 0, the two ends are blended.
        region: part of the sensor for which latent frames are synthesised; elsewhere the ends are blended. The first
            row and column are even. ``None`` for the whole sensor.

    Raises:
        ValueError: ``latent`` is negative, or ``region`` is empty or starts at an odd pixel.

    Example:
        >>> Plan(latent=3).region is None  # for the whole sensor
        True
    """

    latent: int = 0
    region: Region | None = None

    def __post_init__(self) -> None:
        if self.latent < 0:
            raise ValueError(f"latent: expected 0 frames or more, got {self.latent}")
        top, left, height, width = self.region or (0, 0, 1, 1)
        if min(top, left) < 0 or top % 2 or left % 2 or min(height, width) < 1:
            raise ValueError(f"region: expected an even row and column, and a size, got {self.region}")

    @classmethod
    def everything(cls, clocks: int) -> Plan:
        """Return the plan that models every clock of the interval at all pixels."""
        return cls(check_whole("clocks", clocks) - 1)


@dataclass(frozen=True)
class SceneProfile:
    r"""Motion in an interval between two frames.

    Convention:
        Displacements are in sensor pixels. A pixel is static if its light changes so little in the interval that the
        error of its charge at the end is below the tolerance for any course of the light between the ends.

    Args:
        size: rows and columns of the sensor.
        clocks: clocks of an interval.
        static: share of static pixels.
        region: smallest rectangle, starting at even pixels, that contains all pixels that are not static; ``None`` if
            there are none.
        displacement: 99th percentile of the displacement per clock of pixels that are not static, weighted by the
            squared slope of the light along the motion, as motion without a slope is invisible.
        blending: conservative estimate of the share of spikes that change if the ends of the interval are blended, from
            the displacements and the curvature of the light along them.
    """

    size: tuple[int, int]
    clocks: int
    static: float = 1.0
    region: Region | None = None
    displacement: float = 0.0
    blending: float = 0.0

    def plan(self, *, spike_tolerance: float = 0.05, step: float = 0.5) -> Plan:
        r"""Return the plan that this interval requires.

        .. math:: K = \max\left(\left\lceil \frac{d}{\text{step}} \right\rceil,
            \left\lceil \sqrt{\text{blending} / \text{spike tolerance}} \right\rceil\right)

        Convention:
            K - 1 latent frames, at most one per clock, divide an interval into K steps. A pixel with displacement d
            moves by at most ``step`` between two of them, and by less if the light has so much detail that blending
            would change more spikes than the tolerance; the error of blending falls with :math:`K^2`. Static pixels
            need no latent frames. If motion estimation has failed, every clock is modelled: the interpolation sees
            finer detail, and may find motion or a cut.

        Args:
            spike_tolerance: share of the spikes that may change.
            step: largest displacement between two latent frames, in sensor pixels.

        Returns:
            The plan.

        Raises:
            ValueError: ``spike_tolerance`` or ``step`` is not above 0.
        """
        check_positive("spike_tolerance", spike_tolerance)
        check_positive("step", step)
        moves, steps, region = self.displacement * self.clocks, self.clocks, None
        if math.isfinite(moves):
            steps = max(1, math.ceil(moves / step), math.ceil(math.sqrt(self.blending / spike_tolerance)))
            steps = min(steps, self.clocks)
            region = _grown(self.region, self.size, math.ceil(moves) + _MARGIN) if steps > 1 and self.region else None
            if region and region[2] * region[3] > _NEARLY_ALL * math.prod(self.size):
                region = None
        return Plan(steps - 1, region)


def profile_interval(
    first: Tensor,
    second: Tensor,
    *,
    scale: int,
    pattern: Pattern = "RGGB",
    alpha: float = 0.4,
    clocks: int = 20,
    spike_tolerance: float = 0.05,
    motion: Callable[[Tensor, Tensor], Any] | None = None,
) -> SceneProfile:
    r"""Profile the motion between two neighbouring frames of a film, at the sensor's resolution.

    .. math:: \text{blending} = 4 \, \frac{T}{6} \, \frac{\overline{\min(d^2, d) \, |I''|}}{\overline{I}}

    Convention:
        Motion is estimated on frames averaged to cells of 2 x 2 sensor pixels, which have ``4 * scale**2`` times fewer
        pixels, and only around pixels that change. A common change of brightness is compensated first. If there is a
        cut, or forward and backward flow disagree nearly everywhere, displacement and blending are infinite.

        Estimate of blending: light I with second derivative :math:`I''` that moves by a step of :math:`\delta` pixels
        differs from linear interpolation by :math:`\delta^2 |I''| / 12` on average. Over the T clocks of an interval
        these errors accumulate in the charge while :math:`I''` keeps its sign, for about one pixel of displacement. An
        error E of the charge moves a spike with probability E, and a moved spike changes two bits. The factor 4
        accounts for detail that is finer than the sensor's pixels.

    Frames are (3, H, W), H and W multiples of ``2 * scale``; the other arguments are those of
    :class:`spikekit.FrameSequence`. The default for ``motion`` is ``FlowInterpolation(shrink=1)``, as Bayer cells are
    already small.
    """
    light = torch.stack([alpha * bin_to_sensor(frame, pattern, scale=scale) for frame in (first, second)])
    size, pixels, mean = tuple(light.shape[-2:]), light[0].numel(), light.mean().item()
    moving = (light[1] - light[0]).abs() * clocks > spike_tolerance * mean
    region = _bounds(moving)
    if region is None:
        return SceneProfile(size, clocks)

    top, left, height, width = _grown(region, size, 2 * _MARGIN)
    part = slice(top, top + height), slice(left, left + width)
    moving = moving[part]
    small = torch.stack([F.avg_pool2d(frame, scale)[(..., *part)] for frame in (first, second)])
    gain = ((small[1] + _BLACK) / (small[0] + _BLACK)).mean(0)[moving].median()
    cells = F.avg_pool2d(small, 2)
    motion = FlowInterpolation(shrink=1) if motion is None else motion
    found = motion(cells[0], (cells[1] / gain).clamp(0, 1))
    lost = SceneProfile(size, clocks, 1 - moving.sum().item() / pixels, region, math.inf, math.inf)
    if found.forward is None or found.backward is None:
        return lost
    forward, backward = (upsample_flow(flow[None], 2) for flow in (found.forward, found.backward))

    distance = forward[0].norm(dim=0)
    there_and_back = (forward + flow_warp(backward, forward))[0].norm(dim=0)
    sure = moving & (there_and_back < _CONSISTENT * (1 + distance))
    if sure.sum() < _FEW * moving.sum():
        return lost
    slope, bend = (
        mosaic(plane.abs(), pattern) for plane in _derivatives(small[0], forward[0] / distance.clamp(min=_FINE))
    )
    error = (torch.minimum(distance.square(), distance) * bend * sure).sum() * (moving.sum() / sure.sum())
    return replace(
        lost,
        displacement=_fast(distance, slope.square() * sure) / clocks,
        blending=_SAFETY * clocks / 6 * alpha * error.item() / pixels / mean,
    )


def _derivatives(rgb: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first and second derivatives of a picture (3, H, W) along unit vectors (2, H, W)."""
    around = F.pad(rgb[None], (1, 1, 1, 1), "replicate")[0]
    middle = slice(1, -1)
    left, right = around[:, middle, :-2], around[:, middle, 2:]
    above, below = around[:, :-2, middle], around[:, 2:, middle]
    mixed = (around[:, 2:, 2:] - around[:, 2:, :-2] - around[:, :-2, 2:] + around[:, :-2, :-2]) / 4
    x, y = direction
    first = (x * (right - left) + y * (below - above)) / 2
    second = x * x * (left + right - 2 * rgb) + 2 * x * y * mixed + y * y * (above + below - 2 * rgb)
    return first, second


def _fast(distance: Tensor, weight: Tensor) -> float:
    """Return the weighted 99th percentile of the displacement."""
    distance, order = distance.flatten().sort()
    below = weight.flatten()[order].double().cumsum(0)
    return distance[torch.searchsorted(below, 0.99 * below[-1])].item()


def _grown(region: Region, size: tuple[int, int], margin: int) -> Region:
    """Return the rectangle grown by a margin, clipped to the sensor and aligned to cells."""
    top, left = (max(0, first - margin) // 2 * 2 for first in region[:2])
    bottom, right = (
        min(most, first + length + margin + 1) // 2 * 2
        for most, first, length in zip(size, region[:2], region[2:], strict=True)
    )
    return top, left, bottom - top, right - left


def _bounds(moving: Tensor) -> Region | None:
    """Return the smallest rectangle that contains all True pixels and starts at even pixels."""
    rows, columns = (moving.any(dim).nonzero().flatten().tolist() for dim in (1, 0))
    if not rows:
        return None
    top, left = rows[0] // 2 * 2, columns[0] // 2 * 2
    return top, left, rows[-1] + 1 - top, columns[-1] + 1 - left
