"""Simulations on disk: from frames to a stream, its ground truth and its side-car."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from spikekit.flow.interpolate import Blend, FlowInterpolation, Still
from spikekit.io.files import write_spikes
from spikekit.io.formats import dat_bytes
from spikekit.io.image_bytes import png_bytes
from spikekit.io.sidecar import Sidecar, published, versions
from spikekit.io.video import VideoFrames, read_video
from spikekit.io.whole_file import whole_file
from spikekit.progress import progress
from spikekit.scenes.adaptive_sampling import Plan
from spikekit.scenes.frame_sequence import FrameSequence
from spikekit.sensor.noise import SensorNoise

_SHOWN = 2  # intervals whose plans are told one by one

#: What makes latent frames, by name.
INTERPOLATIONS = {kind.__name__: kind for kind in (FlowInterpolation, Blend, Still)}


@dataclass(frozen=True)
class Settings:
    """Settings that a stream depends on, besides its source, as in side-cars; see :class:`spikekit.FrameSequence`."""

    scale: int
    pattern: str = "RGGB"
    alpha: float = 0.4
    clocks: int = 20
    frame: int | None = None  #: the source frame at the middle of a clip; the middle one when not given
    frames: int | None = 41  #: of the stream; ``None`` for the whole film
    readout: int = 1
    seed: int = 0
    plan: str | int = "scene"  #: what the scene requires, ``everything``, or a number of latent frames
    tolerance: float = 0.05
    step: float = 0.5
    interpolation: str = "FlowInterpolation"  #: one of :data:`INTERPOLATIONS`
    noise: SensorNoise = field(default_factory=SensorNoise)
    calibration: str | None = None  #: the file of the sensor that was measured, whose pixels ``noise`` has

    def __post_init__(self) -> None:
        if not (self.plan in ("scene", "everything") or self.plan in range(self.clocks)):
            raise ValueError(
                f"plan: expected scene, everything or 0 to {self.clocks - 1} latent frames in {self.clocks} clocks, "
                f"got {self.plan}"
            )

    def film(self, frames: Sequence[Tensor]) -> FrameSequence:
        """Return the film of these frames."""
        plan = None
        if self.plan != "scene":
            plan = Plan.everything(self.clocks) if self.plan == "everything" else Plan(self.plan)
        return FrameSequence(
            frames,
            scale=self.scale,
            pattern=self.pattern,
            alpha=self.alpha,
            clocks=self.clocks,
            interpolation=INTERPOLATIONS[self.interpolation](),
            plan=plan,
            spike_tolerance=self.tolerance,
            step=self.step,
        )


class Source:
    """The frames of a folder, of a video file or of one still picture that a stream is made of, read when needed."""

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path, self.film_frames = path, read_video(path)
        total, clocks = len(self.film_frames), settings.clocks
        self.still = total == 1
        self.frame = None
        if settings.frames is None:
            if settings.frame is not None:
                raise ValueError(f"frame: expected none with the whole film, got {settings.frame}")
            if self.still:
                raise ValueError(f"frames: expected a number, as {path} is one picture without an end, got all")
            self.first, self.span = 0, range(total)
            self.clocks = ((total - 1) * clocks + 1) // settings.readout * settings.readout
            self.truth = {index: index * clocks for index in range(total) if index * clocks < self.clocks}
            return
        self.clocks = settings.frames * settings.readout
        before, after = self.clocks // 2, (self.clocks - 1) // 2
        needed = -(-before // clocks), -(-after // clocks)
        frame = total // 2 if settings.frame is None else settings.frame
        least, most = (0, 0) if self.still else (needed[0], total - 1 - needed[1])
        if not least <= frame <= most:
            fits = f"{least} to {most}" if least <= most else "more frames, or fewer clocks"
            raise ValueError(
                f"frame: expected {fits}, got {frame}: {self.clocks} clocks, {clocks} from one frame to the next, need "
                f"{needed[0]} of the {total} frames of {path} before the middle and {needed[1]} after it"
            )
        self.frame = frame
        self.span = range(frame - needed[0], frame + needed[1] + 1)
        self.first = needed[0] * clocks - before
        self.truth = {needed[0]: before}

    @property
    def used(self) -> VideoFrames:
        """The frames that are looked at, each once."""
        return self.film_frames if self.still else self.film_frames[self.span.start : self.span.stop]

    @property
    def frames(self) -> Sequence[Tensor]:
        """The frames of the film; a still picture as often as it takes."""
        return [self.film_frames[0]] * len(self.span) if self.still else self.used

    def file(self, name: str) -> Path:
        """Return where the frame of this name is read from."""
        return self.path / name if self.path.is_dir() else self.path


def simulate(source: Source, settings: Settings, output: Path) -> list[str]:
    """Write a stream, and beside it its ground truth and its side-car; return what was done, line by line."""
    stem = output.stem
    names = source.used.names
    pictures = {index: Path(f"{stem}.png") for index in source.truth}
    if settings.frames is None:
        bare = [Path(name).stem for name in names]
        bare = bare if len(set(bare)) == len(bare) else names
        pictures = {index: Path(stem, f"{bare[index]}.png") for index in source.truth}
    sources = {os.path.realpath(source.file(name)) for name in names}
    for picture in pictures.values():
        if os.path.realpath(output.parent / picture) in sources:
            raise ValueError(f"{output}: its ground truth, {picture}, would replace the source; choose another name")
    try:
        film = settings.film(source.frames)
    except ValueError as error:
        raise ValueError(f"{source.path}: {error}") from error
    height, width = film.height // film.scale, film.width // film.scale
    known = settings.noise.calibration
    if known is not None and known.size != (height, width):
        sizes = f"expected {height} x {width} pixels as the film gives them, got {known.size[0]} x {known.size[1]}"
        raise ValueError(f"{settings.calibration}: {sizes}")
    with _one_thread(), published(output) as part:
        for index, picture in progress(pictures.items(), "pictures"):
            with whole_file(part / picture) as file:
                file.write(png_bytes(film.rgb(index)))
        noise, told = _needed_noise(source, settings, film)
        plans: list[Plan] = []
        bits, digest = _expose(source, settings, film, noise, part / output.name, plans)
        frames = source.clocks // settings.readout
        sidecar = Sidecar(
            stream={"file": output.name, "frames": frames, "height": height, "width": width, "sha256": digest},
            truth={path.as_posix(): source.truth[index] / settings.readout for index, path in pictures.items()},
            source={"path": str(source.path), "frames": names},
            settings=asdict(replace(settings, frame=source.frame, noise=replace(settings.noise, calibration=None))),
            plan={
                "noise": asdict(replace(noise, calibration=None)),
                "intervals": [{"latent": plan.latent, "region": plan.region} for plan in plans],
            },
            versions=versions(),
        )
        with whole_file(part / f"{stem}.json", "w", encoding="utf-8") as file:
            file.write(sidecar.dumps())
    return _report(source, settings, film, sidecar, bits, [*_plan_lines(plans, source), *told], output)


def _needed_noise(source: Source, settings: Settings, film: FrameSequence) -> tuple[SensorNoise, list[str]]:
    """Return the noise that changes spikes, and a line about it."""
    noise, frames = settings.noise, settings.frames
    if noise == SensorNoise():
        return noise, []
    if frames is None or settings.plan == "everything":
        return noise, ["noise: all that was asked for"]
    looks = range(len(film.frames))
    light = sum(film.light(n * settings.clocks, 1).mean().item() for n in looks) / len(looks)
    needed = noise.required(light, frames, settings.tolerance * min(1.0, light))
    kept = needed.spike_changes(light, frames)
    left_out = [source for source in noise.spike_changes(light, frames) if source not in kept]
    without = f" (left out: {', '.join(left_out)})" if left_out else ""
    return needed, [f"noise: {', '.join(kept) or 'none'}{without}"]


def _expose(
    source: Source, settings: Settings, film: FrameSequence, noise: SensorNoise, path: Path, plans: list[Plan]
) -> tuple[int, str]:
    """Write the stream, and collect the plans of its intervals; return how many bits are set, and its hash."""
    digest = hashlib.sha256()
    bits, clock = 0, source.first

    def passing() -> Iterator[Tensor]:
        nonlocal bits, clock
        how = {"noise": noise, "readout": settings.readout, "seed": settings.seed, "chunk": settings.clocks}
        for spikes in film.spikes(source.first, source.clocks, **how):
            bar.update(len(spikes))
            digest.update(dat_bytes(spikes.numpy()))
            bits += int(spikes.sum())
            begin, clock = clock, clock + len(spikes) * settings.readout
            for interval in range(begin // settings.clocks, -(-(clock - 1) // settings.clocks)):
                if interval == source.first // settings.clocks + len(plans):
                    plans.append(film.plan(interval))
            yield spikes

    with progress(what=f"frames of {path.name}", total=source.clocks // settings.readout) as bar:
        write_spikes(path, passing())
    return bits, digest.hexdigest()


def _plan_lines(plans: list[Plan], source: Source) -> list[str]:
    if source.still:
        return str(plans[0]).splitlines()
    if len(plans) <= _SHOWN:
        told = zip(plans, source.used.names, strict=False)
        return [
            line for plan, name in told for line in (f"from {name}:", *(f"  {said}" for said in str(plan).split("\n")))
        ]
    latent = [plan.latent for plan in plans]
    return [
        f"latent frames: {min(latent)} to {max(latent)} an interval, {sum(latent) / len(latent):.1f} on average, none "
        f"in {latent.count(0)} of {len(latent)} intervals"
    ]


def _report(
    source: Source, settings: Settings, film: FrameSequence, sidecar: Sidecar, bits: int, plan: list[str], output: Path
) -> list[str]:
    frames, height, width = (sidecar.stream[key] for key in ("frames", "height", "width"))
    stored, seen = (source.used.height, source.used.width), (film.height, film.width)
    where = f"{source.path}, {_few(source.used.names)}" if source.path.is_dir() else f"{source.path}"
    cropped = "" if stored == seen else f", the first {seen[0]} x {seen[1]} of them"
    pixels = [f"pixels as {settings.calibration} has them"] if settings.calibration else []
    picture, frame = next(iter(sidecar.truth.items()))
    others = len(sidecar.truth) - 1
    report = {
        "source": [f"{where}: {stored[0]} x {stored[1]} (H x W){cropped}"],
        "sensor": [
            f"{height} x {width}, {film.pattern}, a white pixel fires {settings.alpha:g} times a clock",
            *pixels,
        ],
        "plan": plan,
        "stream": [f"{output}: {frames} frames, {bits / (frames * height * width):.2%} of the bits set"],
        "truth": [
            f"{output.parent / picture}" + (f" and {others} more" if others else f", seen at frame {int(frame)}")
        ],
        "side-car": [f"{output.with_suffix('.json')}: all settings, and SHA-256 {sidecar.stream['sha256'][:16]}..."],
    }
    return [f"{'' if n else name:12} {line}" for name, lines in report.items() for n, line in enumerate(lines)]


def _few(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} .. {names[-1]} ({len(names)} frames)"


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sum in one order, however many cores there are: sums in another order differ in their last bits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
