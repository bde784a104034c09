"""The verb ``lightning models``."""

from __future__ import annotations

from collections.abc import Sequence

from lightning_modules.cli.errors import VerbParser
from lightning_modules.shipped import list_pretrained
from spikekit.tables import table


def models(args: Sequence[str]) -> None:
    """Print the weights that come with the package.

    Args:
        args: what was typed after ``lightning models``.
    """
    parser = VerbParser(
        prog="lightning models",
        description="List the weights that come with the package, for lightning predict --model.weights NAME and "
        "CSCSR.from_pretrained(NAME).",
    )
    parser.parse_args(args)
    rows = []
    for one in list_pretrained():
        megabytes = one.path.stat().st_size / 1e6
        rows.append([one.name, one.scale and f"x{one.scale}", one.size, f"{one.parameters:,}", f"{megabytes:.1f}"])
    print(table(["weights", "scale", "size", "parameters", "MB"], rows))
