"""Style and output of the charts of sweep and trade."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from spikekit.io.whole_file import whole_file

BLUE, ORANGE, GREY = "#265ca0", "#c86014", "#969696"

_STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#dedede",
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": "medium",
    "font.size": 9,
    "grid.color": "#dedede",
    "legend.frameon": False,
    "savefig.dpi": 160,
    "text.parse_math": False,  # names are what users typed
}


@contextmanager
def chart(path: Path, width: float, height: float) -> Iterator[Any]:
    """Yield the matplotlib axes of one chart, and write it when they are filled.

    Args:
        path: of the picture; its ending names the format.
        width: inches.
        height: inches.
    """
    import matplotlib
    from matplotlib.figure import Figure  # no window, nothing global

    with matplotlib.rc_context({**matplotlib.rcParamsDefault, **_STYLE}):
        figure = Figure((width, height), layout="constrained")
        yield figure.add_subplot()
        with whole_file(path) as file:
            figure.savefig(file, format=path.suffix[1:])
