"""Films as scenes: light, ground truth and flow of a sequence of frames at every clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.check import check_picture, check_positive, check_size, check_whole
from spikekit.color.cfa import Pattern, bin_to_sensor, cfa_pattern
from spikekit.flow.interpolate import Blend, FlowInterpolation, Still
from spikekit.scenes.adaptive_sampling import Plan, Region, SceneProfile, profile_interval
from spikekit.sensor.noise import SensorNoise
from spikekit.sensor.simulate import SpikeSensor
from spikekit.warp.warp import flow_warp

#: Version of the simulation from frames to spikes. Increment it with every change of light, spikes or flow in any
#: module: cached clips are then simulated again. A test knows the output of every version.
SIMULATOR_VERSION = 1

T = TypeVar("T")

_KEPT = 2  # frames and intervals kept in memory: a clip and its flow use two intervals


class FrameSequence:
    r"""A sequence of frames, seen by a colour spike camera.

    Convention:
        The sensor sees frame f at clock ``f * clocks``; the film ends at the clock of its last frame. The interval
        between two frames is interpolated according to its :class:`Plan`: the light of the two ends and of the latent
        frames is blended linearly in time. Every interval has its own plan, made from its :class:`SceneProfile`, unless
        ``plan`` is given.

        Light at the clock of a frame or latent frame is ``alpha * bin_to_sensor(rgb, pattern, scale=scale)``; nothing
        is linearised.

        The view is the largest part of the frames, from the top left, whose sides are multiples of ``2 * scale``. Rows
        and columns are cut only at the bottom and the right, which keeps positions and the Bayer phase.

        The light of a clock depends only on the two frames around it, not on spans, chunks or their order. Two frames
        and two intervals are held in memory.

    Args:
        frames: sequence of ``rgb`` (3, H, W), floating, in [0, 1], such as :class:`spikekit.VideoFrames`.
        scale: width of a sensor pixel in frame pixels.
        pattern: Bayer phase of the sensor, see :func:`spikekit.bayer_pattern`, or ``"grey"``.
        alpha: light of a white pixel per clock, in thresholds.
        clocks: clocks from one frame to the next.
        interpolation: function of two frames that returns a :class:`spikekit.Between`; default:
            :class:`spikekit.FlowInterpolation`.
        plan: plan of every interval, such as ``Plan.everything(clocks)``; default: made for each interval.
        spike_tolerance: share of the spikes that may differ from a full simulation, see :meth:`SceneProfile.plan`.
        step: largest displacement between latent frames, in sensor pixels, see :meth:`SceneProfile.plan`.
        motion: flow estimation of the profile, see ``spikekit.scenes.adaptive_sampling.profile_interval``.

    Raises:
        TypeError: a frame is not a floating-point tensor.
        ValueError: there are no frames, a frame is smaller than a cell of the sensor or differs in size, the pattern is
            unknown, ``scale`` or ``clocks`` is not a whole number >= 1, or ``alpha``, ``spike_tolerance`` or ``step``
            is not above 0.

    Example:
        >>> picture = torch.rand(3, 34, 41)
        >>> film = FrameSequence([picture.roll(n, -1) for n in range(3)], scale=4)
        >>> film.height, film.width, film.clock_count
        (32, 40, 41)
        >>> bool((film.rgb(1) == picture.roll(1, -1)[:, :32, :40]).all())
        True
        >>> film.light(18, 5).shape
        torch.Size([5, 8, 10])

    Reference:
        Dong et al., CVPR 2024, section 5.1.
    """

    def __init__(
        self,
        frames: Sequence[Tensor],
        *,
        scale: int,
        pattern: Pattern = "RGGB",
        alpha: float = 0.4,
        clocks: int = 20,
        interpolation: Callable[[Tensor, Tensor], Any] | None = None,
        plan: Plan | None = None,
        spike_tolerance: float = 0.05,
        step: float = 0.5,
        motion: Callable[[Tensor, Tensor], Any] | None = None,
    ) -> None:
        if len(frames) == 0:
            raise ValueError("frames: expected at least one, got none")
        scale = check_whole("scale", scale)
        for name, value in (("alpha", alpha), ("spike_tolerance", spike_tolerance), ("step", step)):
            check_positive(name, value)
        self.frames, self.scale, self.pattern = frames, scale, cfa_pattern(pattern)
        self.alpha, self.clocks = alpha, check_whole("clocks", clocks)
        self.interpolation = FlowInterpolation() if interpolation is None else interpolation
        self.spike_tolerance, self.step, self.motion = spike_tolerance, step, motion
        self.fixed = plan
        if plan is None and isinstance(self.interpolation, (Blend, Still)):  # these do not use motion
            self.fixed = Plan() if isinstance(self.interpolation, Blend) else Plan.everything(self.clocks)
        self._views: dict[int, Tensor] = {}
        self._intervals: dict[int, _Interval] = {}
        self._size = tuple(self._read(0).shape[1:])
        cell = 2 * scale
        self.height, self.width = (side // cell * cell for side in self._size)
        if 0 in (self.height, self.width):
            raise ValueError(f"frames: expected {cell} x {cell} pixels or more, got {self._size[0]} x {self._size[1]}")

    @property
    def clock_count(self) -> int:
        """Clocks from the first frame to the last, both included."""
        return (len(self.frames) - 1) * self.clocks + 1

    def rgb(self, frame: int) -> Tensor:
        """Return the view of a source frame, bit for bit.

        Args:
            frame: number of the frame, 0 to ``len(frames) - 1``.

        Returns:
            ``rgb`` of shape (3, height, width).

        Raises:
            ValueError: ``frame`` is out of range, or the frame differs in size from the first.
        """
        return self._view(frame).clone()

    def light(self, first: int = 0, count: int | None = None) -> Tensor:
        """Return the light that arrives at the sensor at every clock of a span.

        Args:
            first: the first clock.
            count: number of clocks; default: up to the end of the film.

        Returns:
            ``light`` of shape (count, height / scale, width / scale).

        Raises:
            ValueError: the span is out of range, or a frame differs in size from the first.
        """
        count = self._count(first, count)
        light = []
        for clock in range(first, first + count):
            frame, phase = divmod(clock, self.clocks)
            light.append(self._interval(frame).light(phase) if phase else self._seen(self._view(frame)))
        return torch.stack(light)

    def spikes(
        self,
        first: int = 0,
        count: int | None = None,
        *,
        noise: SensorNoise | None = None,
        seed: int = 0,
        chunk: int = 64,
    ) -> Iterator[Tensor]:
        """Simulate the spikes of a span of the film, chunk by chunk.

        :func:`spikekit.write_spikes` accepts the result; ``torch.cat(list(film.spikes()))`` is the whole film.

        Args:
            first: the first clock.
            count: number of clocks; default: up to the end of the film.
            noise: noise of the sensor, see :class:`spikekit.SensorNoise`.
            seed: random seed of the initial charge and the noise.
            chunk: clocks per chunk.

        Returns:
            An iterator over chunks of spikes (T, height / scale, width / scale), uint8.

        Raises:
            ValueError: as :meth:`light` and :class:`spikekit.SpikeSensor`, or ``chunk`` is below 1.
        """
        sensor = SpikeSensor(noise, seed=seed)
        chunk, last = check_whole("chunk", chunk), first + self._count(first, count)
        return (sensor.expose(self.light(at, min(chunk, last - at))) for at in range(first, last, chunk))

    def clip(self, frame: int, frames: int = 41) -> SequenceClip:
        """Return a clip centred on a source frame.

        Args:
            frame: the source frame at clock ``frames // 2`` of the clip.
            frames: clocks of the clip.

        Returns:
            A scene like :class:`spikekit.Scene`.

        Raises:
            ValueError: the film does not contain all frames of the clip.
        """
        half = check_whole("frames", frames) // 2
        first, last = frame - -(-half // self.clocks), frame + -(-(frames - 1 - half) // self.clocks)
        if first < 0 or last >= len(self.frames):
            raise ValueError(
                f"frame: a clip of {frames} clocks around frame {frame}, {self.clocks} per interval, needs frames "
                f"{first} to {last}, got 0 to {len(self.frames) - 1}"
            )
        return SequenceClip(self, frame, frames)

    def plan(self, interval: int) -> Plan:
        """Return the plan of the interval between frame ``interval`` and the next.

        Args:
            interval: 0 to ``len(frames) - 2``.

        Returns:
            The plan.

        Raises:
            ValueError: ``interval`` is out of range, or a frame differs in size from the first.
        """
        return self._interval(interval).plan

    def flow(self, frame: int, clock: float) -> Tensor:
        """Return the flow from a source frame to a clock, as estimated by the interpolation.

        Convention:
            As :meth:`spikekit.Scene.flow`: sensor pixels, order (x, y). Motion within an interval is linear; the flows
            of several intervals are concatenated. Intervals whose profile is static have flow 0.

        Args:
            frame: number of the source frame.
            clock: target clock, counted from the first frame of the film.

        Returns:
            ``flow`` of shape (2, height / scale, width / scale).

        Raises:
            ValueError: ``clock`` is out of range, or there is no flow to it.
        """
        if not 0 <= clock < self.clock_count:
            raise ValueError(f"clock: expected 0 to {self.clock_count - 1}, got {clock}")
        way = clock / self.clocks - frame
        moved = self._view(frame).new_zeros(1, 2, self.height, self.width)
        while way:
            share = min(abs(way), 1.0)
            interval = self._interval(frame if way > 0 else frame - 1)
            if self.fixed is not None or interval.profile.region is not None:
                between = interval.between(None)
                flow = between.forward if way > 0 else between.backward
                if flow is None:
                    raise ValueError(f"clock: no flow from frame {frame}: a cut, or an interpolation without flow")
                moved = moved + share * flow_warp(flow[None], moved)
            frame, way = (frame + 1, way - share) if way > 0 else (frame - 1, way + share)
        return F.avg_pool2d(moved, self.scale)[0] / self.scale

    def _count(self, first: int, count: int | None) -> int:
        left = self.clock_count - first
        count = left if count is None else count
        if first < 0 or not 1 <= count <= left:
            expected = f"expected clocks of the film, 0 to {self.clock_count - 1}"
            raise ValueError(f"first, count: {expected}, got {count} from {first} on")
        return count

    def _read(self, frame: int) -> Tensor:
        rgb = self.frames[frame]
        check_picture(f"frames[{frame}]", rgb)
        return rgb

    def _view(self, frame: int) -> Tensor:
        if not 0 <= frame < len(self.frames):
            raise ValueError(f"frame: expected 0 to {len(self.frames) - 1}, got {frame}")

        def read() -> Tensor:
            rgb = self._read(frame)
            check_size(f"frames[{frame}]", rgb.shape[1:], self._size, " as the first frame")
            return rgb[:, : self.height, : self.width].contiguous()

        return _kept(self._views, frame, read)

    def _seen(self, rgb: Tensor) -> Tensor:
        return self.alpha * bin_to_sensor(rgb, self.pattern, scale=self.scale)

    def _interval(self, index: int) -> _Interval:
        if not 0 <= index < len(self.frames) - 1:
            raise ValueError(f"interval: expected 0 to {len(self.frames) - 2}, got {index}")
        return _kept(self._intervals, index, lambda: _Interval(self, self._view(index), self._view(index + 1)))


class _Interval:
    """Two neighbouring frames and the light between them, computed lazily."""

    def __init__(self, film: FrameSequence, first: Tensor, second: Tensor) -> None:
        self.film, self.frames = film, (first, second)
        self._betweens: dict[Region | None, Any] = {}
        self._latent: dict[int, Tensor] = {}

    @cached_property
    def profile(self) -> SceneProfile:
        """Profile of the interval."""
        names = "scale", "pattern", "alpha", "clocks", "spike_tolerance", "motion"
        return profile_interval(*self.frames, **{name: getattr(self.film, name) for name in names})

    @cached_property
    def plan(self) -> Plan:
        """Plan of the interval."""
        film = self.film
        return film.fixed or self.profile.plan(spike_tolerance=film.spike_tolerance, step=film.step)

    @cached_property
    def _ends(self) -> tuple[Tensor, ...]:
        return tuple(map(self.film._seen, self.frames))

    def between(self, region: Region | None = None) -> Any:
        """Return the interpolation for a region of the sensor; default: the whole sensor."""
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


def _kept(kept: dict[int, T], index: int, make: Callable[[], T]) -> T:
    """Return a cached value, or make and cache it, dropping the oldest; safe with several threads."""
    value = kept.get(index)
    if value is None:
        value = kept[index] = make()
        for oldest in list(kept)[:-_KEPT]:
            kept.pop(oldest, None)
    return value


@dataclass(frozen=True)
class SequenceClip:
    """A clip around a source frame: a scene like :class:`spikekit.Scene`, see :meth:`FrameSequence.clip`.

    Args:
        sequence: the film.
        frame: number of the source frame at the middle.
        frames: clocks of the clip.
    """

    sequence: FrameSequence
    frame: int
    frames: int = 41

    @property
    def middle(self) -> int:
        """Clock of the source frame in the clip."""
        return self.frames // 2

    @property
    def first(self) -> int:
        """Clock of the sequence at which the clip starts."""
        return self.frame * self.sequence.clocks - self.middle

    @property
    def height(self) -> int:
        """Rows of the view."""
        return self.sequence.height

    @property
    def width(self) -> int:
        """Columns of the view."""
        return self.sequence.width

    def rgb(self, clock: int) -> Tensor:
        """Return the view at the clock of a source frame; at the middle it is the ground truth.

        Raises:
            ValueError: there is no source frame at ``clock``.
        """
        frame, phase = divmod(self.first + clock, self.sequence.clocks)
        if phase:
            raise ValueError(f"clock: expected the clock of a source frame, such as {self.middle}, got {clock}")
        return self.sequence.rgb(frame)

    def light(self) -> Tensor:
        """Return the light at every clock, (frames, height / scale, width / scale)."""
        return self.sequence.light(self.first, self.frames)

    def flow(self, clock: float, *, scale: int | None = None) -> Tensor:
        """Return the flow from the middle to a clock, see :meth:`FrameSequence.flow`.

        Raises:
            ValueError: ``scale`` differs from that of the sequence, or as :meth:`FrameSequence.flow`.
        """
        if scale not in (None, self.sequence.scale):
            raise ValueError(f"scale: expected {self.sequence.scale}, that of the sequence, got {scale}")
        return self.sequence.flow(self.frame, self.first + clock)
