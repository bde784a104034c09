"""Simulation to files: from frames to a stream, its ground truth and its side-car."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spikekit._version import __version__
from spikekit.arguments import UsageError
from spikekit.check import check_size
from spikekit.color.cfa import GREY, bin_to_sensor
from spikekit.flow.interpolate import Blend, FlowInterpolation, Still
from spikekit.io.files import write_spikes
from spikekit.io.formats import dat_bytes
from spikekit.io.images import png_bytes
from spikekit.io.sidecar import Sidecar, published
from spikekit.io.video import read_video
from spikekit.io.whole_file import write_whole
from spikekit.progress import progress
from spikekit.scenes.adaptive_sampling import Plan
from spikekit.scenes.frame_sequence import FrameSequence
from spikekit.sensor.noise import SensorNoise

#: Interpolations by name.
INTERPOLATIONS = {kind.__name__: kind for kind in (FlowInterpolation, Blend, Still)}


@dataclass(frozen=True)
class Settings:
    """Settings of a simulation, as stored in side-cars; see :class:`spikekit.FrameSequence`."""

    scale: int
    pattern: str = "RGGB"
    alpha: float = 0.4
    clocks: int = 20
    frame: int | None = None  #: source frame at the middle of the clip; default: the middle of the film
    frames: int | None = 41  #: spike frames of the stream; ``None`` for the whole film
    seed: int = 0
    plan: str | int = "scene"  #: ``scene``, ``everything``, or a number of latent frames per interval
    spike_tolerance: float = 0.05
    step: float = 0.5
    interpolation: str = "FlowInterpolation"  #: one of :data:`INTERPOLATIONS`
    noise: SensorNoise = field(default_factory=SensorNoise)
    calibration: str | None = None  #: file of the calibration in ``noise``

    def film(self, frames: Sequence[Tensor]) -> FrameSequence:
        """Return the film of the given frames."""
        plan = None
        if self.plan != "scene":
            plan = Plan.everything(self.clocks) if self.plan == "everything" else Plan(self.plan)
        how = {name: getattr(self, name) for name in ("scale", "pattern", "alpha", "clocks", "spike_tolerance", "step")}
        return FrameSequence(frames, interpolation=INTERPOLATIONS[self.interpolation](), plan=plan, **how)

    def span(self, film: FrameSequence) -> tuple[int, int, dict[int, int]]:
        """Return the first clock of the stream, the number of clocks, and the clocks of the ground truth by frame."""
        if self.frames is None:
            if self.frame is not None:
                raise ValueError(f"frame: expected none with the whole film, got {self.frame}")
            return 0, film.clock_count, {n: n * self.clocks for n in range(len(film.frames))}
        clip = film.clip(len(film.frames) // 2 if self.frame is None else self.frame, self.frames)
        return clip.first, clip.frames, {clip.frame: clip.middle}


def simulate(path: Path, settings: Settings, output: Path) -> list[str]:
    """Write a stream, its ground truth and its side-car; return the lines of a report.

    Raises:
        UsageError: a setting is invalid for these frames.
        ValueError: a file is invalid or would be overwritten; the message names it.
    """
    video = frames = read_video(path)
    if len(video) == 1:  # a still picture, repeated as needed
        if settings.frames is None:
            raise UsageError(f"--frames: expected a number, as {path} is a single picture, got all")
        frames, settings = [video[0]] * (settings.frames // settings.clocks + 3), replace(settings, frame=None)
    try:
        film = settings.film(frames)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    height, width = film.height // film.scale, film.width // film.scale
    known = settings.noise.calibration
    if known is not None:
        check_size(settings.calibration, known.size, (height, width), " pixels, as in the film")
    try:
        first, count, clocks = settings.span(film)
    except ValueError as error:
        raise UsageError(f"--{error}") from error
    looked_at = range(first // film.clocks, -(-(first + count - 1) // film.clocks) + 1)
    names = video.names if len(video) == 1 else [video.names[n] for n in looked_at]
    stem = output.stem
    pictures = {frame: Path(f"{stem}.png") for frame in clocks}
    if settings.frames is None:
        bare = [Path(name).stem for name in names]
        bare = bare if len(set(bare)) == len(bare) else names
        pictures = {frame: Path(stem, f"{bare[frame]}.png") for frame in clocks}
    sources = {os.path.realpath(path / name if path.is_dir() else path) for name in names}
    for picture in pictures.values():
        if os.path.realpath(output.parent / picture) in sources:
            raise ValueError(f"{output}: its ground truth {picture} would overwrite the source; choose another name")
    with _one_thread(), published(output) as part:
        for frame, picture in progress(pictures.items(), "pictures"):
            rgb = film.rgb(frame)
            write_whole(part / picture, png_bytes(bin_to_sensor(rgb, GREY, scale=1) if film.pattern == GREY else rgb))
        noise, left_out = _needed_noise(settings, film, looked_at)
        plans: dict[int, Plan] = {}
        bits, digest = _expose(settings, film, (first, count), noise, part / output.name, plans)
        sidecar = Sidecar(
            stream={"file": output.name, "frames": count, "height": height, "width": width, "sha256": digest},
            truth={picture.as_posix(): clocks[frame] for frame, picture in pictures.items()},
            source={"path": str(path), "frames": names},
            settings=asdict(replace(settings, noise=replace(settings.noise, calibration=None))),
            plan={
                "noise": asdict(replace(noise, calibration=None)),
                "intervals": [{"latent": plan.latent, "region": plan.region} for plan in plans.values()],
            },
            versions={"spikekit": __version__, "torch": torch.__version__, "numpy": np.__version__},
        )
        write_whole(part / f"{stem}.json", sidecar.dumps())
    latent = [plan.latent for plan in plans.values()]
    return [
        f"source       {path}: {video.height} x {video.width} (H x W), cropped to {film.height} x {film.width}",
        f"sensor       {height} x {width}, {film.pattern}, white level {settings.alpha:g} spikes per clock",
        f"latent       {sum(latent)} frames in {len(latent)} intervals, {latent.count(0)} of which need none",
        f"left out     {', '.join(left_out) or 'nothing'}",
        f"stream       {output}: {count} frames, {bits / (count * height * width):.2%} of the bits set",
        f"truth        {output.parent / next(iter(pictures.values()))}, {len(pictures)} in total",
        f"side-car     {output.with_suffix('.json')}: all settings, and SHA-256 {digest[:16]}...",
    ]


def _needed_noise(settings: Settings, film: FrameSequence, frames: range) -> tuple[SensorNoise, list[str]]:
    """Return the noise that affects the spikes, and the names of the sources that are left out."""
    noise, count = settings.noise, settings.frames
    if noise == SensorNoise() or count is None or settings.plan == "everything":
        return noise, []
    light = sum(film.light(n * film.clocks, 1).mean().item() for n in frames) / len(frames)
    needed = noise.required(light, count, settings.spike_tolerance * min(1.0, light))
    kept = needed.spike_changes(light, count)
    return needed, [source for source in noise.spike_changes(light, count) if source not in kept]


def _expose(
    settings: Settings,
    film: FrameSequence,
    span: tuple[int, int],
    noise: SensorNoise,
    path: Path,
    plans: dict[int, Plan],
) -> tuple[int, str]:
    """Write the stream and collect the plans of its intervals; return the number of spikes and the hash."""
    digest = hashlib.sha256()
    bits, clock = 0, span[0]

    def passing() -> Iterator[Tensor]:
        nonlocal bits, clock
        for spikes in film.spikes(*span, noise=noise, seed=settings.seed, chunk=film.clocks):
            bar.update(len(spikes))
            digest.update(dat_bytes(spikes.numpy()))
            bits += int(spikes.sum())
            begin, clock = clock, clock + len(spikes)
            plans.update((n, film.plan(n)) for n in range(begin // film.clocks, -(-(clock - 1) // film.clocks)))
            yield spikes

    with progress(what=f"frames of {path.name}", total=span[1]) as bar:
        write_spikes(path, passing())
    return bits, digest.hexdigest()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Use one thread, so that the order of sums, and with it the stream, does not depend on the number of cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
