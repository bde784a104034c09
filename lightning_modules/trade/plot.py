"""The plot of a trade: PSNR over time per frame, and the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning_modules.sweep.plot import axis
from lightning_modules.trade.measure import Row
from lightning_modules.trade.table import figures, front

_ZOOM = 2  # drawn larger, so that text and dots are smooth
_LEFT, _TOP, _WIDTH, _HEIGHT, _FOOT, _LINE = 62, 40, 560, 400, 56, 18
_FRONT, _OTHER, _INK, _GRID = (38, 92, 160), (150, 150, 150), (40, 40, 40), (222, 222, 222)
_DOT = 4


def plot(rows: Sequence[Row], path: Path) -> None:
    """Draw a numbered dot a setting, those of the front in blue and joined by its steps, and the names beside it."""
    from PIL import Image, ImageDraw, ImageFont

    shown = [(n, values["ms"], values["psnr"]) for n, values in enumerate(figures(rows)) if values]
    best = front(rows)
    fastest, slowest, ticks = _log_axis([ms for _, ms, _ in shown])
    low, high, step = axis([psnr for _, _, psnr in shown])

    font = ImageFont.load_default(12 * _ZOOM)
    names = [f"{n + 1}  {row.setting.name}" + (" (cannot run)" if row.reason else "") for n, row in enumerate(rows)]
    beside = _LEFT + _WIDTH + 24
    size = (
        beside + math.ceil(max(map(font.getlength, names)) / _ZOOM) + 16,
        _TOP + max(_HEIGHT + _FOOT, _LINE * len(rows) + 16),
    )
    image = Image.new("RGB", [side * _ZOOM for side in size], "white")
    draw = ImageDraw.Draw(image)

    def at(ms: float, psnr: float) -> tuple[float, float]:
        share = math.log(ms / fastest) / math.log(slowest / fastest)
        return _LEFT + share * _WIDTH, _TOP + (high - psnr) / (high - low) * _HEIGHT

    def write(x: float, y: float, text: str, anchor: str, fill: Any = _INK) -> None:
        around = {"stroke_width": 2 * _ZOOM, "stroke_fill": "white"}  # readable on lines, too
        draw.text((x * _ZOOM, y * _ZOOM), text, fill=fill, font=font, anchor=anchor, **around)

    def line(points: Sequence[tuple[float, float]], fill: Any, width: int = 1) -> None:
        draw.line([(x * _ZOOM, y * _ZOOM) for x, y in points], fill=fill, width=width * _ZOOM)

    write(_LEFT, 16, "PSNR (dB)", "lm")
    for n in range(round((high - low) / step) + 1):
        _, y = at(fastest, low + n * step)
        line([(_LEFT, y), (_LEFT + _WIDTH, y)], _GRID)
        digits = max(0, -math.floor(math.log10(step) + 1e-9))
        write(_LEFT - 8, y, f"{low + n * step:.{digits}f}", "rm")
    for ms in ticks:
        x, _ = at(ms, low)
        line([(x, _TOP), (x, _TOP + _HEIGHT)], _GRID)
        write(x, _TOP + _HEIGHT + 8, f"{ms:g}", "mt")
    write(_LEFT + _WIDTH, _TOP + _HEIGHT + 30, "ms a frame", "rt")

    points = {n: at(ms, psnr) for n, ms, psnr in shown}
    corners = [points[n] for n in best]
    steps = [(x, before) for (x, _), (_, before) in zip(corners[1:], corners, strict=False)]
    joined = [point for pair in zip(corners, [*steps, corners[-1]], strict=True) for point in pair]
    line([*joined, (_LEFT + _WIDTH, corners[-1][1])], _FRONT)
    labels = _labels(points)
    for n, label in labels.items():
        line([points[n], label], _GRID)
    for n in sorted(points, key=lambda n: n in best):
        (x, y), fill = points[n], _FRONT if n in best else _OTHER
        box = [(x - _DOT) * _ZOOM, (y - _DOT) * _ZOOM, (x + _DOT) * _ZOOM, (y + _DOT) * _ZOOM]
        draw.ellipse(box, fill=fill)
    for n, (x, y) in labels.items():
        write(x, y, str(n + 1), "mm", _FRONT if n in best else _INK)
    for n, name in enumerate(names):
        write(beside, _TOP + _LINE * n, name, "lm", _FRONT if n in best else _INK)
    image.save(path)


def _labels(points: dict[int, tuple[float, float]]) -> dict[int, tuple[float, float]]:
    """Find a place beside every point, as free of other points and labels as there is."""
    taken = list(points.values())
    places = {}
    for n, (x, y) in points.items():
        around = [
            (x + away * math.cos(turn * math.pi / 8), y - away * math.sin(turn * math.pi / 8))
            for away in (13, 22, 31)
            for turn in (4, 2, 6, 0, 8, 14, 10, 12, 3, 5, 1, 7, 15, 9, 13, 11)
        ]

        def room(place: tuple[float, float], own: tuple[float, float] = (x, y)) -> float:
            return min(14.0, *(math.dist(place, other) for other in taken if other != own), math.inf)

        places[n] = max(around, key=room)
        taken.append(places[n])
    return places


def _log_axis(values: Sequence[float]) -> tuple[float, float, list[float]]:
    """Return ends of a logarithmic axis and what is written at it: powers of ten, and 2 and 5 times those."""
    low, high = min(values) / 1.25, max(values) * 1.25
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [factor * 10.0**power for power in powers for factor in (1, 2, 5)]
    return low, high, [tick for tick in ticks if low <= tick <= high]
