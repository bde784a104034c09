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
    """Show how far work is and how long it still takes, on stderr where that is a terminal.

    Args:
        things: what is worked through; without them, ``update`` says how far the work is.
        what: is worked through, in a word or two.
        total: how many there are; the length of ``things`` when not given.
        how: other arguments of ``tqdm``.

    Returns:
        An iterator over the things, which is a context as well; the bar is gone when the work is done.

    Example:
        >>> [n * n for n in progress(range(3), "squares")]
        [0, 1, 4]
    """
    from tqdm import tqdm

    return tqdm(things, printable(what), total, **{"disable": None, "leave": False, "delay": AFTER, **how})
