"""The arguments that name a recording, the same for every verb that reads one."""

from __future__ import annotations

import argparse
import sys
from inspect import signature
from typing import Any

from spikekit.arguments import home_path, whole
from spikekit.calibration.files import ENDING
from spikekit.color.cfa import GREY, PATTERNS
from spikekit.io.cameras import CAMERAS
from spikekit.recording import Recording, open_recording
from spikekit.standard_output import say

_OPTIONS = [name for name in signature(open_recording).parameters if name != "path"]


def add_arguments(parser: Any, *, calibration: bool = True) -> None:
    """Add FILE and what is to be known of it; the calibration too, where the verb corrects pixels."""
    add = parser.add_argument
    add("file", type=home_path, metavar="FILE", help="a recording, .dat (8 pixels a byte, no header), .npy or .npz")
    add("--height", type=whole(1), metavar="H", help="rows of a frame; a .dat without side-car or camera needs it")
    add("--width", type=whole(1), metavar="W", help="columns of a frame; likewise")
    add("--flip", action="store_true", help="the frames are stored upside down, as real cameras do")
    add(
        "--pattern",
        type=pattern,
        choices=(*PATTERNS, GREY),
        metavar="P",
        help=f"Bayer phase after the flip: {', '.join(PATTERNS)}; or {GREY}; that of the side-car or the camera if not "
        "given",
    )
    add(
        "--camera",
        metavar="NAME",
        help=f"what recorded it: {', '.join(CAMERAS)}, or a .json file of the same form; gives the size, the "
        "flip, the Bayer phase, what to crop, and how pictures are shown",
    )
    if calibration:
        add(
            "--calibration",
            metavar="FILE",
            help="gain, dark rate and defects of the pixels, from spikekit calibrate, to correct pictures by; "
            f"the recording's own, NAME{ENDING} beside it, if not given; none for none",
        )


def pattern(text: str) -> str:
    """Read a Bayer phase in either case, or ``grey``."""
    return text.lower() if text.lower() == GREY else text.upper()


def known(args: argparse.Namespace) -> dict[str, Any]:
    """Return what is said of the recording, as :func:`spikekit.recording.open_recording` takes it."""
    return {name: getattr(args, name) for name in _OPTIONS if hasattr(args, name)}


def opened(args: argparse.Namespace) -> Recording:
    """Open the recording that the arguments name, and print its note to stderr."""
    recording = open_recording(args.file, **known(args))
    if recording.note:
        say(f"note: {recording.note}", sys.stderr)
    return recording
