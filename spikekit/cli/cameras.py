"""``spikekit cameras``: the cameras that ``--camera`` knows."""

from __future__ import annotations

import argparse

from spikekit.io.cameras import CAMERAS, camera
from spikekit.tables import table


def run(args: argparse.Namespace) -> None:
    """Print the cameras that --camera knows, and what it knows of them.

    Sizes are those of the pictures, after the crop; the Bayer phase is that of upright frames, before it.
    """
    rows = []
    for one in map(camera, CAMERAS):
        height, width = one.prepared_size
        flip = "upside down" if one.flip else "upright"
        rows.append([one.name, f"{height} x {width}", one.pattern or "grey", flip, f"{one.rate:g}", one.title])
    print(table(["camera", "H x W", "Bayer", "stored", "frames/s", "what it is"], rows, markdown=args.markdown))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("--markdown", action="store_true", help="a Markdown table")
