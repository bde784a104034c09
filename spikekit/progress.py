"""Progress bars, shown on terminals only."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from spikekit.arguments import printable

if TYPE_CHECKING:
    from tqdm import tqdm

#: seconds before a bar appears
AFTER = 0.5


def progress(things: Iterable[Any] | None = None, what: str = "", total: float | None = None, **how: Any) -> tqdm:
    """Return a ``tqdm`` bar that shows on stderr if that is a terminal, and is cleared at the end."""
    from tqdm import tqdm

    return tqdm(things, printable(what), total, **{"disable": None, "leave": False, "delay": AFTER, **how})
