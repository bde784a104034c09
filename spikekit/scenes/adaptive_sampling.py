"""Adaptive sampling of films: profile motion and brightness, and plan how many latent frames they require."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from kornia.color import CFA
from torch import Tensor

from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import bin_to_sensor, mosaic
from spikekit.flow.fields import upsample_flow
from spikekit.flow.interpolate import FlowInterpolation
from spikekit.warp.warp import flow_warp

#: A rectangle of the sensor: first row, first column, rows, columns.
Region = tuple[int, int, int, int]

# Sensor pixels around what moves that are interpolated with it, beyond its displacement: flow looks at neighbours.
_MARGIN = 8

# Sensor pixels by which motion there and back may miss its start, at rest; as much more per pixel of way.
_CONSISTENT = 0.1

# Where flow is consistent for fewer of the moving pixels than this, motion is not found.
_FEW = 0.1

_NEARLY_ALL = 0.75  # share of the sensor from which on no region is cut out

_FINE = 1e-6  # shorter motion has no direction

# How many times as many spikes change, at most, as curvature seen at the sensor's pixels tells: it misses finer detail,
# and over wide detail that moves far the charge keeps its sign for longer than for a pixel.
_SAFETY = 4

_BLACK = 1e-3  # added to both of two lights whose ratio is a gain


@dataclass(frozen=True)
class Plan:
    """Moments modelled in an interval between two frames; light is blended linearly in time between them.

    Args:
        latent: frames that are synthesised in the interval, evenly spaced; with none, its two ends are blended.
        region: the part of the sensor they are synthesised for, the ends being blended in the rest; first row and
            column even; ``None`` for all of it.

    Raises:
        ValueError: a negative number of frames, a region that begins at an odd pixel or has none.

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
        """Model everything: a frame for every clock of the interval, all pixels."""
        return cls(check_whole("clocks", clocks) - 1)


@dataclass(frozen=True)
class SceneProfile:
    r"""How a scene moves, from frames that are some clocks apart.

    Convention:
        Displacements are in sensor pixels. A pixel is static where its light changes so
        little in an interval that its charge is off by less than the tolerance at the end, whichever way the light
        takes from one end to the other.

    Args:
        size: rows and columns of the sensor.
        clocks: clocks of an interval.
        static: share of static pixels.
        region: the smallest rectangle, beginning at even pixels, that holds all others; ``None`` without any.
        displacement: per clock, in pixels that are not static; one per cent is faster, by weight of the squared slope
            of the light along the motion, because where there is none, motion neither shows nor matters.
        blending: share of the spikes that would change if the ends of an interval were blended, estimated from the
            displacements and from how the light bends along them, and on the safe side.
    """

    size: tuple[int, int]
    clocks: int
    static: float = 1.0
    region: Region | None = None
    displacement: float = 0.0
    blending: float = 0.0

    def plan(self, *, spike_tolerance: float = 0.05, step: float = 0.5) -> Plan:
        r"""Decide what must be modelled.

        .. math:: K = \max\left(\left\lceil \frac{d}{\text{step}} \right\rceil,
            \left\lceil \sqrt{\text{blending} / \text{spike tolerance}} \right\rceil\right)

        Convention:
            An interval is cut into K steps by K - 1 latent frames, at most one a clock. A pixel whose displacement in
            an interval is d moves by at most ``step`` between two of them, and by less where the light has so much
            detail that blending would change more spikes than the tolerance: its error falls with :math:`K^2`.
            Nothing is synthesised where nothing moves, and a frame for every clock where motion is not found: the
            interpolation may find it in finer detail, or that the film was cut.

        Args:
            spike_tolerance: share of the spikes that may change.
            step: displacement between two latent frames, in sensor pixels.

        Returns:
            The plan; change it by ``dataclasses.replace``.

        Raises:
            ValueError: a tolerance or a step that is not above 0.
        """
        check_positive("spike_tolerance", spike_tolerance)
        check_positive("step", step)
        height, width = self.size
        moves, steps, region = self.displacement * self.clocks, self.clocks, None
        if math.isfinite(moves):
            steps = max(1, math.ceil(moves / step), math.ceil(math.sqrt(self.blending / spike_tolerance)))
            steps = min(steps, self.clocks)
            region = _grown(self.region, self.size, math.ceil(moves) + _MARGIN) if steps > 1 and self.region else None
            if region and region[2] * region[3] > _NEARLY_ALL * height * width:
                region = None
        return Plan(steps - 1, region)


def profile_interval(
    first: Tensor,
    second: Tensor,
    *,
    scale: int,
    pattern: str | CFA = "RGGB",
    alpha: float = 0.4,
    clocks: int = 20,
    spike_tolerance: float = 0.05,
    motion: Callable[[Tensor, Tensor], Any] | None = None,
) -> SceneProfile:
    r"""Look at two neighbouring frames of a film, as coarsely as the sensor sees them.

    .. math:: \text{blending} = 4 \, \frac{T}{6} \, \frac{\overline{\min(d^2, d) \, |I''|}}{\overline{I}}

    Convention:
        Motion is looked for in the frames averaged to cells of 2 x 2 sensor pixels, ``4 * scale**2`` times fewer
        pixels than they have, and only where something changes; not at all where nothing does. A gain that all pixels
        have in common is taken out before. Where the film is cut, or flow there and back ends elsewhere nearly
        everywhere, displacement and blending are infinite.

        The estimate: light I that moves by a step of :math:`\delta` pixels bends by :math:`\delta^2 I''` on the way,
        and a straight line between the ends is off by :math:`\delta^2 |I''| / 12` on average. Over the T clocks of an
        interval this adds up in the charge, as long as the sign of :math:`I''` stays: for about one pixel of way. A
        charge that is off by E moves a spike with probability E, and a spike that moves changes two bits. The estimate
        is multiplied by four for detail that is finer than the sensor's pixels.

    Frames are (3, H, W), H and W multiples of ``2 * scale``; the other arguments are those of
    :class:`spikekit.FrameSequence`. Motion is found by ``FlowInterpolation(shrink=1)`` by default, because Bayer cells
    are small already.
    """
    light = [alpha * bin_to_sensor(frame, pattern, scale=scale) for frame in (first, second)]
    ends = torch.stack(light)
    size = tuple(ends.shape[-2:])
    mean = ends.mean().item()
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
    lost = SceneProfile(size, clocks, 1 - moving.sum().item() / ends[0].numel(), region, math.inf, math.inf)
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
    pixels = ends[0].numel()
    return replace(
        lost,
        displacement=_fast(distance, slope.square() * sure) / clocks,
        blending=_SAFETY * clocks / 6 * alpha * error.item() / pixels / mean,
    )


def _derivatives(rgb: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first and the second derivative of a picture (3, H, W) along a direction (2, H, W) of length 1."""
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
    """Return the displacement that 99 per cent of the weight does not exceed."""
    distance, order = distance.flatten().sort()
    below = weight.flatten()[order].double().cumsum(0)
    return distance[torch.searchsorted(below, 0.99 * below[-1])].item()


def _grown(region: Region, size: tuple[int, int], margin: int) -> Region:
    """Return the rectangle with a margin, as far as the sensor goes, in whole cells."""
    top, left = (max(0, first - margin) // 2 * 2 for first in region[:2])
    bottom, right = (
        min(most, first + length + margin + 1) // 2 * 2
        for most, first, length in zip(size, region[:2], region[2:], strict=True)
    )
    return top, left, bottom - top, right - left


def _bounds(moving: Tensor) -> Region | None:
    """Return the smallest rectangle that holds all that is true and begins at even pixels."""
    rows, columns = (moving.any(dim).nonzero().flatten().tolist() for dim in (1, 0))
    if not rows:
        return None
    top, left = rows[0] // 2 * 2, columns[0] // 2 * 2
    return top, left, rows[-1] + 1 - top, columns[-1] + 1 - left
