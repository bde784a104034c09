"""``spikekit simulate``: from pictures or a video to a spike stream, its ground truth and its side-car."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from spikekit.arguments import UsageError, ending_in, home_path, positive, whole
from spikekit.calibration.files import read_calibration
from spikekit.color.cfa import PATTERNS
from spikekit.io.files import RECORDING_ENDINGS
from spikekit.scenes.simulation import INTERPOLATIONS, Settings, simulate
from spikekit.sensor.noise import SensorNoise
from spikekit.standard_output import say

_NOISE = {
    "photons": "electrons that make a threshold: light comes in photons",
    "dark_current": "charge that leaks into a pixel per clock, in thresholds",
    "dark_spread": "standard deviation of the dark current between pixels, relative to its mean",
    "gain_spread": "standard deviation of the gain between pixels: fixed-pattern noise",
    "hot": "share of pixels that always fire",
    "dead": "share of pixels that never fire",
}


def run(args: argparse.Namespace) -> None:
    """Record a film with a simulated colour spike camera.

    OUT.dat gets the stream, 8 pixels a byte: a clip around one frame of the film, or all of it. OUT.png gets the
    ground truth, that frame in 8 bits, cropped to whole cells of the sensor; with --all, the folder OUT gets every
    frame. OUT.json, the side-car, gets every setting, what of the scene was modelled, and a hash of the stream. The
    same settings give the same stream, bit for bit.

    All appear under their names when they are complete, the side-car last: a stream without one is not to be
    believed.
    """
    if args.output.is_dir():
        raise ValueError(f"{args.output}: expected a stream to write, got a folder")
    known = {field.name for field in (*fields(Settings), *fields(SensorNoise))}
    given = {name: value for name, value in vars(args).items() if name in known}
    noise = {name: given.pop(name) for name in _NOISE if name in given}
    pixels = read_calibration(given["calibration"]) if "calibration" in given else None
    try:
        settings = Settings(**given, noise=SensorNoise(**noise, calibration=pixels))
    except ValueError as error:
        raise UsageError(f"--{str(error).replace('_', '-', 1)}") from error
    for line in simulate(args.input, settings, args.output):
        say(line)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.argument_default = argparse.SUPPRESS  # Settings has the defaults
    add = parser.add_argument

    def option(name: str, kind: Callable[[str], Any], metavar: str, said: str, to: Any = parser) -> None:
        to.add_argument(f"--{name}", type=kind, metavar=metavar, help=f"{said}; {getattr(Settings, name)} if not given")

    add("input", type=home_path, metavar="INPUT", help="a folder of pictures, a video file or a picture")
    stream = ending_in(*RECORDING_ENDINGS, said=f"a stream that ends in {', '.join(RECORDING_ENDINGS)}")
    add("-o", "--output", required=True, type=stream, metavar="OUT.dat", help="the stream to write")
    add("--scale", required=True, type=whole(1), metavar="S", help="pixels of a frame that a sensor pixel is wide")
    said = f"Bayer phase of the sensor; {Settings.pattern} if not given"
    add("--pattern", type=str.upper, choices=PATTERNS, help=said)
    option("alpha", positive, "A", "times that a white pixel fires per clock")
    option("clocks", whole(1), "N", "clocks from one frame to the next")
    part = parser.add_mutually_exclusive_group()
    option("frames", whole(1), "N", "frames of the stream, around one of the film", part)
    part.add_argument("--all", dest="frames", action="store_const", const=None, help="the whole film")
    said = "which frame of the film is in the middle, from 0; that in its middle if not given"
    add("--frame", type=whole(0), metavar="M", help=said)
    option("seed", whole(0), "N", "random seed: first charge and noise")

    model = parser.add_argument_group("what is modelled")
    said = "what the scene requires, every clock and all noise, or K latent frames between two frames"
    option("plan", _plan, "scene|everything|K", said, model)
    said = "share of the spikes that may change by not modelling more"
    model.add_argument(
        "--spike-tolerance",
        dest="tolerance",
        type=positive,
        metavar="SHARE",
        help=f"{said}; {Settings.tolerance} if not given",
    )
    option("step", positive, "PIXELS", "largest displacement between latent frames, in sensor pixels", model)
    said = f"what makes latent frames; {Settings.interpolation} if not given"
    model.add_argument("--interpolation", choices=INTERPOLATIONS, help=said)

    noise = parser.add_argument_group("noise of the sensor, none if not given")
    for name, said in _NOISE.items():
        noise.add_argument(f"--{name.replace('_', '-')}", type=float, metavar="X", help=said)
    said = "instead of dark current, spreads and shares, the pixels of a sensor that spikekit calibrate has measured, "
    noise.add_argument("--calibration", metavar="FILE", help=f"{said}their rows as the stream has them")


def _plan(text: str) -> str | int:
    return int(text) if text.isascii() and text.isdigit() else text
