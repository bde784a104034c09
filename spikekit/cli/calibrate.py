"""``spikekit calibrate``: measure the gain, dark rate and defects of a sensor's pixels."""

from __future__ import annotations

import argparse

from spikekit.arguments import UsageError, home_path
from spikekit.calibration.calibration import ENDING, Calibration, read_calibration, write_calibration
from spikekit.calibration.in_motion import (
    LEAST_SEGMENTS,
    MOST_SEGMENTS,
    calibrate_in_motion,
    count_segments,
    segment_length,
)
from spikekit.calibration.measure import Measured, calibrate, find_defects
from spikekit.calibration.pixel_rates import PixelRates
from spikekit.check import check_size
from spikekit.cli import recordings
from spikekit.recording import Recording, open_recording, own_calibration
from spikekit.sensor.noise import DEAD, HOT, WORKS
from spikekit.standard_output import say

_LEAST_FRAMES = 100


def run(args: argparse.Namespace) -> None:
    """Measure the pixels of a sensor, and store the result beside FILE, where other commands find it.

    --flat, a recording of an evenly lit wall out of focus, gives the gain of every pixel. --dark, a recording with the
    lens cap on, gives the dark rate. Together they detect defects best. A few thousand frames each are enough.
    Unevenness of the wall or the lens is attributed to the sensor. Without either, dead and hot pixels are detected in
    FILE itself. If its scene moves across the sensor, gains are estimated too, by comparing pixels that saw the same
    point.

    decode, view, info and lightning predict apply NAME.calibration.safetensors, if it lies beside NAME.dat, or the file
    given by --calibration.
    """
    output = args.output or own_calibration(args.file)
    known = recordings.known(args) | {"calibration": "none"}
    recording = open_recording(args.file, **known)
    if output.suffix != ".safetensors":
        raise UsageError(f"--output: expected a name that ends in .safetensors, got {output}")
    if output.exists():  # do not overwrite other safetensors files, such as weights
        try:
            read_calibration(output)
        except ValueError as error:
            raise ValueError(f"{output}: exists and is not a calibration; choose another name") from error
    others = {name: open_recording(path, **known) for name in ("flat", "dark") if (path := getattr(args, name))}
    for other in others.values():
        check_size(other.path, other.size, recording.size, f" pixels, the size of {recording.path}")
    seen = {name: _halves(other) for name, other in (others or {"scene": recording}).items()}
    try:
        if others:
            found, said = calibrate(seen.get("flat"), seen.get("dark"), recording.bayer), None
        else:
            rates = seen["scene"][0] + seen["scene"][1]
            found = find_defects(rates, recording.bayer)
            moved, said = _in_motion(recording, rates, found.calibration)
            found = moved or found
    except ValueError as error:
        raise ValueError(f"{(args.flat or args.dark or args.file)}: {error}") from error
    measured = found.calibration
    write_calibration(output, measured.flip() if recording.flip else measured)
    works = measured.defects == WORKS
    if said:
        print(f"gain         {said}")
    if found.gain_error is not None:
        print(f"gain         SD {measured.gain[works].std():.2%}, error {found.gain_error:.2%}")
    if found.dark_error is not None:
        dark = measured.dark[works]
        print(f"dark rate    {dark.mean():.2g} spikes per frame, SD {dark.std():.2g}, error {found.dark_error:.1g}")
    for name, kind in (("dead", DEAD), ("hot", HOT)):
        print(f"{name:12} {int((measured.defects == kind).sum())} of {works.numel()} pixels")
    say(f"{output}: {', '.join(f'{name} {half[0].frames + half[1].frames} frames' for name, half in seen.items())}")


def _halves(recording: Recording) -> tuple[PixelRates, PixelRates]:
    frames, half = recording.frames, recording.frames // 2
    if frames < _LEAST_FRAMES:
        raise ValueError(f"{recording.path}: expected at least {_LEAST_FRAMES} frames, got {frames}")
    parts = recording.chunks(0, half, recording.path.name), recording.chunks(half, frames - half, recording.path.name)
    return PixelRates.of(parts[0]), PixelRates.of(parts[1])


def _in_motion(recording: Recording, rates: PixelRates, known: Calibration) -> tuple[Measured | None, str | None]:
    """Measure gains in a moving scene; return the result, or None and the reason."""
    length = segment_length(rates.rate[known.defects == WORKS].mean().item())
    least, frames = LEAST_SEGMENTS * length, min(recording.frames, MOST_SEGMENTS * length)
    if frames < least:
        return None, f"not measured: expected at least {least} frames of a moving scene, got {frames}"
    segments = count_segments(recording.chunks(0, frames, "segments counted"), length)
    found = calibrate_in_motion(segments, known, recording.bayer)
    return found, None if found else f"not measured in {frames} frames: too little motion, or gains are nearly equal"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    recordings.add_arguments(parser, calibration=False)
    add = parser.add_argument
    add("--flat", type=home_path, metavar="FILE", help="recording of even light by the same camera")
    add("--dark", type=home_path, metavar="FILE", help="recording in the dark by the same camera")
    add(
        "-o",
        "--output",
        type=home_path,
        metavar="OUT",
        help=f"file to write; default: NAME{ENDING} beside FILE",
    )
