"""Chart of a sweep: score of every variant, or its difference to the reference, beside the paper's."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from lightning_modules.cost.charts import BLUE, ORANGE, chart
from lightning_modules.sweep.table import VariantResults, differences, reference, score_names


def plot(rows: Sequence[VariantResults], path: Path) -> None:
    """Draw a row a variant: a dot a seed, a bar at their mean, and a diamond for the paper; nothing without results.

    Where J is among them, or CSCSR among other methods, PSNR is drawn as the difference from it, since the paper's
    clips are others.
    """
    names = score_names(rows)
    if not names:
        return
    name = names[0]
    papers = {n: gap for n, row in enumerate(rows) if (gap := _paper_gap(row, rows)) is not None}
    with chart(path, 6.5, 1 + 0.27 * len(rows)) as axes:
        if papers:
            values = [differences(row, reference(row, rows), name) for row in rows]
            axes.set_title(f"PSNR (dB) above or below {'CSCSR' if rows[0].compared else 'J'}, the same seed")
            axes.axvline(0, color="black", linewidth=0.8)
        else:
            values = [list(row.scores(name).values()) for row in rows]
            axes.set_title("PSNR (dB)" if name == "psnr" else name)
        label = "a seed; bar: the mean"
        for n, (row, found) in enumerate(zip(rows, values, strict=True)):
            if found:
                axes.plot(found, [n] * len(found), "o", color=BLUE, markersize=4, label=label)
                axes.vlines(statistics.mean(found), n - 0.3, n + 0.3, color=BLUE, linewidth=1.5)
                label = None
            elif row.failed:
                axes.text(0.01, n, "failed", color=ORANGE, va="center", transform=axes.get_yaxis_transform())
        if papers:
            style = {
                "color": ORANGE,
                "markersize": 5,
                "label": f"the paper, Table {2 if rows[0].compared else 3} (REDS)",
            }
            axes.plot(list(papers.values()), list(papers), "D", **style)
        axes.set_yticks(range(len(rows)), [row.variant for row in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.tick_params(length=0)
        axes.grid(visible=False, axis="y")
        axes.figure.legend(loc="outside lower left", ncols=2)


def _paper_gap(row: VariantResults, rows: Sequence[VariantResults]) -> float | None:
    full = reference(row, rows)
    return None if row.paper is None or full.paper_gap != 0 else row.paper_gap
