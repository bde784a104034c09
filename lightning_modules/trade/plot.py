"""Chart of a trade: PSNR over time per frame, and the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from lightning_modules.cost.charts import BLUE, GREY, chart
from lightning_modules.cost.measure import Measurement
from lightning_modules.trade.table import figures, front


def plot(rows: Sequence[Measurement], path: Path) -> None:
    """Draw a numbered dot a setting, those of the front in blue and joined by its steps, and the names beside it."""
    points = {n: (values["ms"], values["psnr"]) for n, values in enumerate(figures(rows)) if values}
    best = front(rows)
    colors = [BLUE if n in best else "black" for n in range(len(rows))]
    names = [f"{n + 1}  {row.setting.name}" + (" (cannot run)" if row.reason else "") for n, row in enumerate(rows)]
    with chart(path, 10, max(5.0, 0.5 + 0.19 * len(rows))) as axes:
        from matplotlib.patheffects import withStroke
        from matplotlib.ticker import LogLocator, NullLocator

        axes.set(xscale="log", xlabel="ms a frame", ylabel="PSNR (dB)")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        for n in sorted(points, key=lambda n: n in best):
            axes.plot(*points[n], "o", color=BLUE if n in best else GREY, markersize=5)
        right = axes.get_xlim()[1]
        steps = [*(points[n] for n in best), (right, points[best[-1]][1])]
        axes.step(*zip(*steps, strict=True), where="post", color=BLUE, linewidth=1, zorder=1)
        axes.set_xlim(right=right)
        lines = [axes.plot([], [], " ")[0] for _ in rows]
        axes.figure.legend(lines, names, loc="outside right upper", handlelength=0, labelcolor=colors)

        axes.figure.draw_without_rendering()  # where labels are free depends on the layout
        pixels = axes.transData.transform(list(points.values())) * 72 / axes.figure.dpi
        for n, away in zip(points, _labels(pixels.tolist()), strict=True):
            axes.annotate(
                str(n + 1), points[n], away, textcoords="offset points", color=colors[n], ha="center", va="center",
                arrowprops={"arrowstyle": "-", "color": GREY, "linewidth": 0.5}, in_layout=False, zorder=1.5,
                path_effects=[withStroke(linewidth=2, foreground="white")],
            )  # fmt: skip


def _labels(points: Sequence[Sequence[float]]) -> list[tuple[float, float]]:
    """Find a place beside every point, as free of other points and labels as there is: how far away, right and up."""
    taken = [tuple(point) for point in points]
    places = []
    for x, y in list(taken):
        around = [
            (away * math.cos(turn * math.pi / 8), away * math.sin(turn * math.pi / 8))
            for away in (10, 17, 24)
            for turn in (4, 2, 6, 0, 8, 14, 10, 12, 3, 5, 1, 7, 15, 9, 13, 11)
        ]

        def room(place: tuple[float, float], x: float = x, y: float = y) -> float:
            at = x + place[0], y + place[1]
            return min(11.0, *(math.dist(at, other) for other in taken if other != (x, y)), math.inf)

        places.append(max(around, key=room))
        taken.append((x + places[-1][0], y + places[-1][1]))
    return places
