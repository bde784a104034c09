"""Tables of a trade as CSV and Markdown."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from statistics import mean

import numpy as np
import torch

from lightning_modules.inference.presets import Preset
from lightning_modules.metrics.image import why_no_lpips
from lightning_modules.trade.films import PICTURES
from lightning_modules.trade.measure import Measurement, Timed, running
from spikekit.io.whole_file import whole_file
from spikekit.tables import table
from spikekit.timing import cpu_name, software

#: descriptions of the columns, for the table and for ``--help``
COLUMNS = """\
PSNR, SSIM  mean of spikekit.psnr and spikekit.ssim over the test clips, with the network's own estimate of motion
LPIPS       mean over the test clips, with AlexNet, if its weights are available (see lightning_modules.metrics.lpips)
ms a frame  time of one picture, without reading the clip: median of the rounds, with quartiles
ratio       time relative to the first row, median of the rounds; varies less between machines than the time
MiB         peak increase of the memory in use by a clip
parameters  number of parameters, including a learned motion estimator
MAC a pixel multiplications of convolutions and matrix products per sensor pixel, including a learned motion estimator;
            not counted: the search along the motion, classical motion, decoding, elementwise operations
flicker     films: error of the difference of neighbouring pictures, one warped onto the other by the true motion, in
            8-bit steps; correct motion of the scene is no flicker
latency     films: later clocks that a picture waits for
front       on the Pareto front: no other setting is as fast and, to 0.01 dB, as good"""

_OF_FILMS = "flicker", "latency"

#: columns that are left out if empty for all settings
_PERHAPS = ("LPIPS", *_OF_FILMS)


def figures(rows: Sequence[Measurement]) -> list[dict[str, float | None]]:
    """Return the measurements as one dictionary per row; empty for settings that could not run."""
    reference = running(rows)[0].seconds
    found = []
    for row in rows:
        if row.reason is not None:
            found.append({})
            continue
        ratios = [ours / max(first, 1e-9) for ours, first in zip(row.seconds, reference, strict=True)]
        scores = {name: getattr(row, name) for name in ("psnr", "ssim", "lpips", "flicker")}
        values = {name: mean(score) if score else None for name, score in scores.items()}
        for name, measured in (("ms", [1e3 * seconds for seconds in row.seconds]), ("ratio", ratios)):
            quarters = np.quantile(measured, [0.25, 0.5, 0.75]).tolist()
            values |= zip((f"{name}_q1", name, f"{name}_q3"), quarters, strict=True)
        cost = {"mib": row.memory, "parameters": row.parameters, "macs": row.macs, "latency": row.latency}
        found.append(values | cost)
    return found


def front(rows: Sequence[Measurement]) -> list[int]:
    """Return the indices of the rows on the Pareto front of time and PSNR, to 0.01 dB, fastest first."""
    points = {n: (values["ms"], -round(values["psnr"], 2)) for n, values in enumerate(figures(rows)) if values}
    found: list[int] = []
    for n in sorted(points, key=points.get):
        best = points[found[-1]] if found else None
        if best is None or points[n][1] < best[1] or points[n] == best:
            found.append(n)
    return found


def machine(rows: Sequence[Measurement], timed: Timed) -> str:
    """Return lines that describe machine, software and measurement."""
    devices = dict.fromkeys(row.runner.device for row in running(rows))
    gpus = [torch.cuda.get_device_name(device) for device in devices if device.type == "cuda"]
    clips, (height, width) = timed.clips, timed.size
    scored = len(running(rows)[0].psnr)
    return "\n".join(
        [
            f"machine  {', '.join([*gpus, cpu_name()])}, {_count(os.cpu_count(), 'core')}, "
            f"{_count(torch.get_num_threads(), 'thread')}",
            software(),
            f"quality  mean of {_count(scored, 'clip')}",
            f"time     {timed.unit}; {_count(clips, 'clip')} of {height} x {width} sensor pixels in turns, "
            f"{_count(timed.rounds, 'round')}",
            *([] if timed.every is None else [f"films    {PICTURES} pictures each, {timed.every} clocks apart"]),
        ]
    )


def markdown(rows: Sequence[Measurement], command: str, timed: Timed) -> str:
    """Return the table as Markdown, with the command that made it."""
    best = front(rows)
    cells = [_cells(values, n in best) if values else {} for n, values in enumerate(figures(rows))]
    header = [name for name in cells[best[0]] if name not in _PERHAPS or any(own.get(name) for own in cells)]
    lines = [
        [n, row.setting.name, *map(own.get, header)] for n, (row, own) in enumerate(zip(rows, cells, strict=True), 1)
    ]
    missing = why_no_lpips()
    failed = [f"{row.setting.name} cannot run: {row.reason}" for row in rows if row.reason is not None]
    notes = [*([missing] if missing else []), *failed, f"```text\n{COLUMNS}\n```", f"```sh\n{command}\n```"]
    parts = [f"```text\n{machine(rows, timed)}\n```", table(["", "setting", *header], lines), *notes]
    return "\n\n".join(parts) + "\n"


def _cells(values: dict[str, float | None], best: bool) -> dict[str, str]:
    return {
        "PSNR (dB)": f"{values['psnr']:.2f}",
        "SSIM": f"{values['ssim']:.4f}",
        "LPIPS": _text(values["lpips"], ".4f"),
        "ms a frame": f"{values['ms']:.4g} ({values['ms_q1']:.4g} .. {values['ms_q3']:.4g})",
        "ratio": f"{values['ratio']:.3g}",
        "MiB": _text(values["mib"], ".1f"),
        "parameters": f"{values['parameters']:,}",
        "MAC a pixel": f"{values['macs']:,.0f}",
        "flicker": _text(values["flicker"], ".3f"),
        "latency": _text(values["latency"], "d"),
        "front": "x" if best else "",
    }


def write_csv(rows: Sequence[Measurement], timed: Timed, path: Path) -> None:
    """Write one row per setting: its preset and its measurements.

    ``reference`` is the setting that the ratios refer to. The columns of the preset are empty for a setting with
    arguments that a preset lacks. :mod:`lightning_modules.inference.presets` reads tables in this form.
    """
    height, width = timed.size
    best, reference = front(rows), running(rows)[0].setting.name
    lines = [
        {
            "setting": row.setting.name,
            **vars(row.setting.preset or Preset()),
            **{name: _text(value, ".10g") for name, value in values.items()},
            "every": timed.every,
            "reference": reference,
            "height": height,
            "width": width,
            "front": int(n in best) if values else "",
            "failed": row.reason,
        }
        for n, (row, values) in enumerate(zip(rows, figures(rows), strict=True))
    ]
    left_out = () if timed.every is not None else (*_OF_FILMS, "every")
    columns = [name for name in lines[best[0]] if name not in left_out]
    with whole_file(path, "w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(lines)


def _text(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
