"""Chart of a trade: PSNR over time per frame, and the Pareto front."""

from __future__ import annotations

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
        for n, point in points.items():
            axes.annotate(str(n + 1), point, (4, 4), textcoords="offset points", color=colors[n], fontsize="small")
