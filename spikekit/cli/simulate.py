"""``spikekit simulate``: turn pictures or a video into a spike stream, its ground truth and its side-car."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from spikekit.arguments import UsageError, ending_in, home_path, positive, whole
from spikekit.calibration.calibration import read_calibration
from spikekit.cli.recordings import pattern
from spikekit.color.cfa import GREY, PATTERNS
from spikekit.io.files import RECORDING_ENDINGS
from spikekit.scenes.simulation import INTERPOLATIONS, Settings, simulate
from spikekit.sensor.noise import SensorNoise
from spikekit.standard_output import say

_NOISE = {
    "photons": "threshold in electrons, for shot noise",
    "dark_current": "dark current of a pixel per clock, in thresholds",
    "dark_spread": "standard deviation of the dark current over the pixels, relative to its mean",
    "gain_spread": "standard deviation of the gain over the pixels (fixed-pattern noise)",
    "hot": "share of pixels that always fire",
    "dead": "share of pixels that never fire",
}


def run(args: argparse.Namespace) -> None:
    """Record a film with a simulated spike camera.

    OUT.dat holds the stream, 8 pixels per byte: a clip around one frame of the film, or the whole film. OUT.png holds
    the ground truth: that frame, in 8 bits of colour or grey, cropped to whole cells of the sensor. With --all, the
    folder OUT holds every frame instead. OUT.json, the side-car, records every setting, what was modelled, and a hash
    of the stream. The same settings give the same stream, bit for bit.

    Files appear under their names when they are complete, the side-car last. A stream without one may be incomplete.
    """
    if args.output.is_dir():
        raise ValueError(f"{args.output}: expected a file, got a folder")
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
        default = getattr(Settings, name.replace("-", "_"))
        to.add_argument(f"--{name}", type=kind, metavar=metavar, help=f"{said}; default: {default}")

    add("input", type=home_path, metavar="INPUT", help="folder of pictures, video or picture")
    stream = ending_in(*RECORDING_ENDINGS, said=f"a stream that ends in {', '.join(RECORDING_ENDINGS)}")
    add("-o", "--output", required=True, type=stream, metavar="OUT.dat", help="stream to write")
    add("--scale", required=True, type=whole(1), metavar="S", help="width of a sensor pixel in pixels of a film frame")
    said = f"Bayer phase of the sensor, or {GREY}; default: {Settings.pattern}"
    add("--pattern", type=pattern, choices=(*PATTERNS, GREY), help=said)
    option("alpha", positive, "A", "spikes of a white pixel per clock")
    option("clocks", whole(1), "N", "clocks from one film frame to the next")
    part = parser.add_mutually_exclusive_group()
    option("frames", whole(1), "N", "spike frames of the stream, centred on one frame of the film", part)
    part.add_argument("--all", dest="frames", action="store_const", const=None, help="simulate the whole film")
    said = "film frame at the middle of the stream, counted from 0; default: the middle of the film"
    add("--frame", type=whole(0), metavar="M", help=said)
    option("seed", whole(0), "N", "random seed of the initial charge and the noise")

    model = parser.add_argument_group("modelling")
    said = "scene: what the scene requires; everything: every clock and all noise; K: K latent frames per interval"
    option("plan", _plan, "scene|everything|K", said, model)
    option("spike-tolerance", positive, "SHARE", "share of the spikes that may differ from a full simulation", model)
    option("step", positive, "PIXELS", "largest displacement between latent frames, in sensor pixels", model)
    said = f"method that interpolates latent frames; default: {Settings.interpolation}"
    model.add_argument("--interpolation", choices=INTERPOLATIONS, help=said)

    noise = parser.add_argument_group("sensor noise (default: none)")
    for name, said in _NOISE.items():
        noise.add_argument(f"--{name.replace('_', '-')}", type=float, metavar="X", help=said)
    said = "pixels measured by spikekit calibrate, instead of dark current, spreads and shares; "
    noise.add_argument("--calibration", metavar="FILE", help=f"{said}rows in the order of the stream")


def _plan(text: str) -> str | int:
    if text.isascii() and text.isdigit():
        return int(text)
    if text not in ("scene", "everything"):
        raise argparse.ArgumentTypeError(f"expected scene, everything or a number of latent frames, got {text}")
    return text
