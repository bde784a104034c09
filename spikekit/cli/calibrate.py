"""``spikekit calibrate``: gain, dark rate and defects of the pixels of a sensor, from its recordings."""

from __future__ import annotations

import argparse
from pathlib import Path

from spikekit.arguments import UsageError
from spikekit.color.cfa import PATTERNS
from spikekit.io import recording as recordings
from spikekit.io.calibration import ENDING, read_calibration, write_calibration
from spikekit.io.failures import writing
from spikekit.io.files import iter_spikes
from spikekit.io.recording import Recording, open_recording, own_calibration
from spikekit.progress import progress
from spikekit.sensor.calibrate import calibrate, find_defects
from spikekit.sensor.calibration import DEAD, HOT
from spikekit.sensor.pixel_rates import PixelRates

_LEAST_FRAMES = 100
_CHUNK = 1 << 24  # pixels that are counted at a time


def run(args: argparse.Namespace) -> None:
    """Measure the pixels of a sensor, and store the result beside FILE, where other commands find it.

    With --flat, a recording of an evenly lit wall out of focus, every pixel gets a gain; with --dark, one with the cap
    on, a dark rate; with both, defects show best. A few thousand frames each are enough. What is uneven about the wall
    or the lens counts as the sensor's. Without either, FILE itself shows dead and hot pixels, and no more: gain cannot
    be told from the texture of a scene.

    decode, view, info and lightning predict correct by NAME.calibration.safetensors beside NAME.dat, or by another with
    --calibration.
    """
    output = args.output or own_calibration(args.file)
    recording = open_recording(_of(args, args.file))
    _check_output(output)
    others = {name: open_recording(_of(args, path)) for name in ("flat", "dark") if (path := getattr(args, name))}
    for other in others.values():
        if other.size != recording.size:
            sizes = " x ".join(map(str, recording.size)), " x ".join(map(str, other.size))
            raise ValueError(f"{other.path}: expected {sizes[0]} pixels as {recording.path} has them, got {sizes[1]}")
    seen = {name: _halves(other) for name, other in (others or {"scene": recording}).items()}
    try:
        if others:
            found = calibrate(seen.get("flat"), seen.get("dark"), recording.pattern)
        else:
            found = find_defects(seen["scene"][0] + seen["scene"][1], recording.pattern)
    except ValueError as error:
        raise ValueError(f"{(args.flat or args.dark or args.file)}: {error}") from error
    known = found.calibration
    with writing(output):
        write_calibration(output, known.flip() if recording.flip else known)
    works = known.defects == 0
    if found.gain_error is not None:
        print(f"gain         {known.gain[works].std():.2%} apart, each known to {found.gain_error:.2%}")
    if found.dark_error is not None:
        dark = known.dark[works]
        print(f"dark rate    {dark.mean():.2g} spikes a frame, {dark.std():.2g} apart, known to {found.dark_error:.1g}")
    for name, kind in (("dead", DEAD), ("hot", HOT)):
        print(f"{name:12} {int((known.defects == kind).sum())} of {works.numel()} pixels")
    print(f"{output}: {', '.join(f'{name} {half[0].frames + half[1].frames} frames' for name, half in seen.items())}")


def _of(args: argparse.Namespace, path: Path) -> argparse.Namespace:
    """Return arguments for another file of the same sensor; what is on the disk does not count."""
    return argparse.Namespace(**{**vars(args), "file": path, "calibration": "none"})


def _halves(recording: Recording) -> tuple[PixelRates, PixelRates]:
    frames, (height, width) = recording.frames, recording.stored
    if frames < _LEAST_FRAMES:
        raise ValueError(f"{recording.path}: expected at least {_LEAST_FRAMES} frames to count, got {frames}")
    chunk, half = max(1, min(_CHUNK // (height * width), 500)), frames // 2
    halves = []
    with progress(what=recording.path.name, total=frames) as bar:
        for start, count in ((0, half), (half, frames - half)):
            reads = {"flip": recording.flip, "start": start, "frames": count, "chunk": chunk}

            def parts(reads=reads):
                for part in iter_spikes(recording.path, height, width, **reads):
                    bar.update(len(part))
                    yield recording.prepare(part)

            halves.append(PixelRates.of(parts()))
    return halves[0], halves[1]


def _check_output(output: Path) -> None:
    """Refuse what is no calibration already, such as the weights of a network."""
    if output.is_dir():
        raise ValueError(f"{output}: expected a file to write, got a folder")
    if output.suffix != ".safetensors":
        raise UsageError(f"--output: expected a name that ends in .safetensors, got {output}")
    if output.exists():
        try:
            read_calibration(output)
        except ValueError as error:
            raise ValueError(f"{output}: would be lost, and is not a calibration; choose another name") from error


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    recordings.add_arguments(parser)
    add = parser.add_argument
    add("--flat", type=Path, metavar="FILE", help="a recording of even light, by the same camera")
    add("--dark", type=Path, metavar="FILE", help="a recording in the dark, by the same camera")
    add("--pattern", type=str.upper, choices=PATTERNS, help="Bayer phase after the flip; grey without it")
    add("-o", "--output", type=Path, metavar="OUT", help=f"the file to write; NAME{ENDING} beside FILE if not given")
