"""Progress of long work, on a terminal and nowhere else."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from spikekit.arguments import printable

if TYPE_CHECKING:
    from tqdm import tqdm

#: seconds after which progress is shown: what takes less is over before it can be read
AFTER = 0.5


def progress(things: Iterable[Any] | None = None, what: str = "", total: float | None = None, **how: Any) -> tqdm:
    """Return a ``tqdm`` that shows how far work is, on stderr where that is a terminal, and is gone afterwards."""
    from tqdm import tqdm

    return tqdm(things, printable(what), total, **{"disable": None, "leave": False, "delay": AFTER, **how})
