"""The verb ``lightning models``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from lightning_modules.cli.errors import VerbParser
from lightning_modules.registry import list_models
from spikekit.tables import table

_LEGEND = """
MMAC/px: million multiplications by sensor pixel, of a picture or of an estimate of motion. Kodak, Vid4: PSNR in dB
of 24 stills in motion, and of foliage and walk at 20 clocks a frame, both at alpha 0.4; to be compared at one scale."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the verb."""
    return VerbParser(
        prog="lightning models",
        description="List the weights that come with the package, for lightning predict --model.weights NAME and "
        "CSCSR.from_pretrained(NAME).",
    )


def models(args: Sequence[str]) -> None:
    """Print the weights that come with the package."""
    parser().parse_args(args)
    rows = []
    for one in list_models():
        cells = [one.name, one.scale and f"x{one.scale}", one.size, f"{one.parameters:,}", f"{one.macs / 1e6:.2f}"]
        scores = [score and f"{score:.2f}" for score in (one.kodak, one.vid4)]
        rows.append([*cells, *scores, f"{one.path.stat().st_size / 1e6:.1f}"])
    print(table(["weights", "scale", "size", "parameters", "MMAC/px", "Kodak", "Vid4", "MB"], rows))
    print(_LEGEND)
