"""Arguments that describe a recording, shared by every verb that reads one."""

from __future__ import annotations

import argparse
import sys
from inspect import signature
from typing import Any

from spikekit.arguments import home_path, whole
from spikekit.calibration.calibration import ENDING
from spikekit.color.cfa import GREY, PATTERNS
from spikekit.io.cameras import CAMERAS
from spikekit.recording import Recording, open_recording
from spikekit.standard_output import say

_OPTIONS = [name for name in signature(open_recording).parameters if name != "path"]


def add_arguments(parser: Any, *, calibration: bool = True) -> None:
    """Add FILE and the options that describe it; ``calibration`` if the verb corrects pixels."""
    add = parser.add_argument
    add("file", type=home_path, metavar="FILE", help="recording: .dat (8 pixels per byte, no header), .npy or .npz")
    add("--height", type=whole(1), metavar="H", help="rows of a frame; required for a .dat without side-car or camera")
    add("--width", type=whole(1), metavar="W", help="columns of a frame; required in the same cases")
    add("--flip", action="store_true", help="frames are stored upside down, as by real cameras")
    add(
        "--pattern",
        type=pattern,
        choices=(*PATTERNS, GREY),
        metavar="P",
        help=f"Bayer phase after the flip: {', '.join(PATTERNS)}, or {GREY}; default: that of the side-car or camera",
    )
    add(
        "--camera",
        metavar="NAME",
        help=f"camera of the recording: {', '.join(CAMERAS)}, or a .json file of the same form; sets size, flip, Bayer "
        "phase, crop and the display of pictures",
    )
    if calibration:
        add(
            "--calibration",
            metavar="FILE",
            help="gain, dark rate and defects of the pixels, measured by spikekit calibrate, to correct pictures; "
            f"default: NAME{ENDING} beside the recording, if it exists; none: no correction",
        )


def pattern(text: str) -> str:
    """Parse a Bayer phase or ``grey`` in any case."""
    return text.lower() if text.lower() == GREY else text.upper()


def known(args: argparse.Namespace) -> dict[str, Any]:
    """Return the keyword arguments of :func:`spikekit.recording.open_recording`."""
    return {name: getattr(args, name) for name in _OPTIONS if hasattr(args, name)}


def opened(args: argparse.Namespace) -> Recording:
    """Open the recording that the arguments name, and print its note to stderr."""
    recording = open_recording(args.file, **known(args))
    if recording.note:
        say(f"note: {recording.note}", sys.stderr)
    return recording
