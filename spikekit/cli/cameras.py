"""``spikekit cameras``: list the cameras that ``--camera`` knows."""

from __future__ import annotations

import argparse

from spikekit.io.cameras import CAMERAS, camera
from spikekit.tables import table


def run(args: argparse.Namespace) -> None:
    """List the cameras that --camera knows, with their properties.

    H x W is the size of pictures after the crop. The Bayer phase is that of upright frames before the crop.
    """
    rows = []
    for one in map(camera, CAMERAS):
        height, width = one.prepared_size
        flip = "upside down" if one.flip else "upright"
        rows.append([one.name, f"{height} x {width}", one.pattern or "grey", flip, f"{one.rate:g}", one.title])
    print(table(["camera", "H x W", "Bayer", "stored", "frames/s", "description"], rows, markdown=False))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb: none."""
