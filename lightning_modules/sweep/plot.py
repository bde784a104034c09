"""The plot of a sweep: how every variant scores, or how far behind J it is, beside the paper's difference."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning_modules.sweep.table import Row, differences, reference, score_names

_ZOOM = 2  # drawn larger, so that text and dots are smooth
_ROW, _WIDTH, _TOP, _FOOT = 26, 460, 44, 62
_OURS, _PAPER, _INK, _GRID = (38, 92, 160), (200, 96, 20), (40, 40, 40), (222, 222, 222)


def plot(rows: Sequence[Row], path: Path) -> None:
    """Draw a row a variant: a dot a seed, a bar at their mean, and a diamond for the paper; nothing without results.

    Where J is among them, PSNR is drawn as the difference from it, since the paper's clips are others.
    """
    from PIL import Image, ImageDraw, ImageFont

    names = score_names(rows)
    if not names:
        return
    name = names[0]
    papers = {row.variant: paper for row in rows if (paper := _paper_gap(row, rows)) is not None}
    if papers:
        values = {row.variant: differences(row, reference(row, rows), name) for row in rows}
        title = "PSNR (dB) above or below J, the same seed"
    else:
        values = {row.variant: list(row.scores(name).values()) for row in rows}
        title = "PSNR (dB)" if name == "psnr" else name
    low, high, step = axis([v for row in values.values() for v in row] + list(papers.values()))

    font = ImageFont.load_default(12 * _ZOOM)
    left = 24 + max(int(font.getlength(row.variant)) for row in rows) // _ZOOM
    size = (left + _WIDTH + 40, _TOP + _ROW * len(rows) + _FOOT)
    image = Image.new("RGB", [side * _ZOOM for side in size], "white")
    draw = ImageDraw.Draw(image)

    def at(value: float) -> float:
        return left + (value - low) / (high - low) * _WIDTH

    def write(x: float, y: float, text: str, anchor: str, fill: Any = _INK) -> None:
        draw.text((x * _ZOOM, y * _ZOOM), text, fill=fill, font=font, anchor=anchor)

    def shape(points: Sequence[tuple[float, float]], fill: Any) -> None:
        draw.polygon([(x * _ZOOM, y * _ZOOM) for x, y in points], fill=fill)

    def line(x: float, top: float, bottom: float, fill: Any, width: int = 1) -> None:
        draw.line([(x * _ZOOM, top * _ZOOM), (x * _ZOOM, bottom * _ZOOM)], fill=fill, width=width * _ZOOM)

    def dot(x: float, y: float) -> None:
        draw.ellipse([(x - 3) * _ZOOM, (y - 3) * _ZOOM, (x + 3) * _ZOOM, (y + 3) * _ZOOM], fill=_OURS)

    def diamond(x: float, y: float) -> None:
        shape([(x - 5, y), (x, y - 5), (x + 5, y), (x, y + 5)], _PAPER)

    bottom = _TOP + _ROW * len(rows)
    write(left, 14, title, "lm")
    for n in range(round((high - low) / step) + 1):
        value = low + n * step
        line(at(value), _TOP - 6, bottom, _INK if papers and abs(value) < step / 2 else _GRID)
        write(at(value), bottom + 6, f"{value:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}", "mt")
    for n, row in enumerate(rows):
        y = _TOP + _ROW * (n + 0.5)
        write(left - 12, y, row.variant, "rm")
        if row.variant in papers:
            diamond(at(papers[row.variant]), y)
        found = values[row.variant]
        for value in found:
            dot(at(value), y)
        if found:
            line(at(statistics.mean(found)), y - 8, y + 8, _OURS, 2)
        elif row.failed:
            write(left + 6, y, "failed", "lm", _PAPER)
    foot = bottom + 42
    dot(left + 4, foot)
    write(left + 14, foot, "a seed; bar: the mean", "lm")
    if papers:
        diamond(left + 174, foot)
        write(left + 184, foot, "the paper, Table 3 (REDS)", "lm")
    image.save(path)


def _paper_gap(row: Row, rows: Sequence[Row]) -> float | None:
    full = reference(row, rows)
    if row.paper is None or full.paper is None or "J" not in [label.upper() for label in full.labels]:
        return None
    return row.paper - full.paper


def axis(values: Sequence[float]) -> tuple[float, float, float]:
    """Return ends and spacing of an axis with round numbers, about five of them."""
    low, high = min(values), max(values)
    span = max(high - low, 0.01)
    power = 10 ** math.floor(math.log10(span / 4))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor * 5 >= span)
    return math.floor(low / step - 0.2) * step, math.ceil(high / step + 0.2) * step, step
