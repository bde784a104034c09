"""The command ``lightning models``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from lightning_modules.cli.errors import VerbParser
from lightning_modules.registry import list_models
from spikekit.tables import table

_LEGEND = """
clip: spike frames of a clip. film: also uses neighbouring pictures of a film. MMAC/px: million multiplications per
sensor pixel, for the picture of a single clip or one motion estimate. PSNR in dB at alpha 0.4, comparable within a
scale. Kodak: 24 stills in motion, single clips. Vid4: foliage and walk, 20 clocks per source frame, as films."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the verb."""
    return VerbParser(
        prog="lightning models",
        description="List the weights of the package, for lightning predict --weights NAME and "
        "CSCSR.from_pretrained(NAME).",
    )


def models(args: Sequence[str]) -> None:
    """Run ``lightning models``: print the weights of the package."""
    parser().parse_args(args)
    rows = []
    for one in list_models():
        cells = [one.name, one.scale and f"x{one.scale}", one.size, one.frames, "yes" if one.film else ""]
        cells += [f"{one.parameters:,}", f"{one.macs / 1e6:.2f}"]
        scores = [score and f"{score:.2f}" for score in (one.kodak, one.vid4)]
        rows.append([*cells, *scores, f"{one.path.stat().st_size / 1e6:.1f}"])
    head = ["weights", "scale", "size", "clip", "film", "parameters", "MMAC/px", "Kodak", "Vid4", "MB"]
    print(table(head, rows))
    print(_LEGEND)
