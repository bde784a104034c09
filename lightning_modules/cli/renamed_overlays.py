"""Overlays of sizes by their former names: ``configs/size/e.yaml`` is ``configs/size/small.yaml`` now."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from lightning_modules.cli.arguments import options

#: what the sizes of a network were called
FORMER_SIZES = {
    "t": "tiny",
    "e": "small",
    "d": "base",
    "w": "large",
    "h": "huge",
    "s": "paper_small",
    "m": "paper_base",
    "l": "paper_large",
}


def with_current_overlays(args: Sequence[str]) -> list[str]:
    """Replace overlays given by former names by the current ones; a line on stderr says so.

    Args:
        args: verb and arguments of ``lightning``.
    """
    args = list(args)
    for end, option, value in list(options(args)):
        current = _current(value) if value and option in ("-c", "--config") else None
        if current:
            args[end - 1] = args[end - 1].removesuffix(value) + current
    return args


@lru_cache
def _current(path: str) -> str | None:
    """Return where an overlay is now, and say so once; None where it is in its place, or was never there."""
    file = Path(path)
    current = file.with_name(f"{FORMER_SIZES.get(file.stem, '')}.yaml")
    if file.parent.name != "size" or file.suffix != ".yaml" or file.exists() or not current.is_file():
        return None
    print(f"{path}: called {current} now", file=sys.stderr)
    return str(current)
