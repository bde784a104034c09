"""The table of a sweep, in the form of the paper's Table 3: a row a variant, seeds averaged."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lightning_modules.arguments import flatten
from lightning_modules.sweep.paper import TABLE_3
from lightning_modules.sweep.state import RESULT, read_json
from lightning_modules.sweep.trials import Trial

#: how metrics are written in a table: heading and decimals
_STYLE = {"psnr": ("PSNR (dB)", 2), "ssim": ("SSIM", 4)}


@dataclass
class Row:
    """A variant and the results of its trials.

    Args:
        trials: of one variant, a seed each.
        results: of those that are finished, by seed.
        failed: why others failed, by seed.
    """

    trials: list[Trial]
    results: dict[int | None, dict[str, Any]] = field(default_factory=dict)
    failed: dict[int | None, str] = field(default_factory=dict)

    @property
    def variant(self) -> str:
        """Its name."""
        return self.trials[0].variant

    @property
    def labels(self) -> tuple[str, ...]:
        """What it is made of."""
        return self.trials[0].labels

    def scores(self, name: str) -> dict[int | None, float]:
        """Return a score by seed, where the test gave it."""
        found = {seed: own_scores(result).get(name) for seed, result in self.results.items()}
        return {seed: value for seed, value in found.items() if value is not None}

    @property
    def paper(self) -> float | None:
        """PSNR that the paper reports for it."""
        scales = {result["network"].get("scale") for result in self.results.values()}
        table = TABLE_3.get(scales.pop(), {}) if len(scales) == 1 else {}
        return table.get(self.trials[0].letter)


def own_scores(result: dict[str, Any]) -> dict[str, float]:
    """Return the scores of the trained network; ``psnr, true flow`` and the like for its other rows of the test."""
    metrics, method = result["metrics"], result["method"]
    if method not in metrics:
        method = next(iter(metrics), "")
    scores = dict(metrics.get(method, {}))
    for other, values in metrics.items():
        if other.startswith(f"{method}, "):
            scores |= {f"{name}{other.removeprefix(method)}": value for name, value in values.items()}
    return scores


def score_names(rows: Sequence[Row]) -> list[str]:
    """Return what was measured, the first of it what variants are compared by."""
    return list(dict.fromkeys(name for row in rows for result in row.results.values() for name in own_scores(result)))


def collect(trials: Sequence[Trial], failed: dict[Path, str]) -> list[Row]:
    """Gather what is there of the results, in the order of the trials."""
    rows: dict[str, Row] = {}
    for trial in trials:
        row = rows.setdefault(trial.variant, Row([]))
        row.trials.append(trial)
        result = read_json(trial.folder / RESULT)
        if result:
            row.results[trial.seed] = result
        elif trial.folder in failed:
            row.failed[trial.seed] = failed[trial.folder]
    return list(rows.values())


def reference(row: Row, rows: Sequence[Row]) -> Row:
    """Return the row that another is compared with: J with all else the same, or else the first."""
    for place in range(len(row.labels)):
        for other in rows:
            rest = other.labels[:place] + other.labels[place + 1 :]
            if other.labels[place].upper() == "J" and rest == row.labels[:place] + row.labels[place + 1 :]:
                return other
    return rows[0]


def differences(row: Row, other: Row, name: str) -> list[float]:
    """Return how much better a row scores than another, seed by seed; of the means, where they share no seed."""
    ours, theirs = row.scores(name), other.scores(name)
    shared = [seed for seed in ours if seed in theirs]
    if not shared and ours and theirs:
        return [statistics.mean(ours.values()) - statistics.mean(theirs.values())]
    return [ours[seed] - theirs[seed] for seed in shared]


def markdown(rows: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    names = score_names(rows)
    names = [name for name in names if "," not in name or name.startswith(names[0])]
    settings = _differing(rows)
    papers = any(row.paper is not None for row in rows)
    compared = list(dict.fromkeys(reference(row, rows).variant for row in rows))
    versus = compared[0] if len(compared) == 1 else "reference"
    header = ["variant", "n", *(_heading(name) for name in names)]
    if names:
        header.append(f"{_heading(names[0])} - {versus}")
    if papers:
        header += ["paper, PSNR on REDS (dB)", "paper - J"]
    header += ["ms/step", "steps", "parameters", *(f"`{name}`" for name in settings)]
    lines = [header, ["---"] * len(header)]
    for row in rows:
        count = f"{len(row.results)}" + (f", {len(row.failed)} failed" if row.failed else "")
        cells = [row.variant, count, *(_mean(row.scores(name).values(), _decimals(name)) for name in names)]
        if names:
            other = reference(row, rows)
            gaps = differences(row, other, names[0]) if other is not row else []
            cells.append(_mean(gaps, _decimals(names[0]), "+"))
        if papers:
            scale = {result["network"].get("scale") for result in row.results.values()}
            best = TABLE_3[scale.pop()]["J"] if row.paper is not None else None
            cells += ["", ""] if best is None else [f"{row.paper:.2f}", f"{row.paper - best:+.2f}"]
        times = [result["seconds_per_step"] for result in row.results.values() if result["seconds_per_step"]]
        cells.append(f"{1000 * statistics.mean(times):.0f}" if times else "")
        cells.append(_values(row, lambda result: result["steps"]))
        cells.append(_values(row, lambda result: f"{result['parameters']:,}"))
        cells += [_values(row, lambda result, name=name: _settings(result).get(name, "")) for name in settings]
        lines.append(cells)
    text = [*("| " + " | ".join(cells) + " |" for cells in lines), ""]
    text.append(
        "Means over seeds ± sample standard deviation; differences seed by seed. The weights tested are the last."
    )
    for row in rows:
        for seed, why in row.failed.items():
            text.append(f"\n{row.variant}{'' if seed is None else f', seed {seed}'}, failed: {why}")
    unfinished = sum(len(row.trials) - len(row.results) - len(row.failed) for row in rows)
    text += [f"\nNot finished: {unfinished} trials."] if unfinished else []
    for method, scores in _others(rows).items():
        text.append(f"\n{method} on the same clips: " + ", ".join(f"{k.upper()} {v:.4g}" for k, v in scores.items()))
    return "\n".join(text) + "\n"


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write every trial, and the mean and spread of every variant."""
    names, settings = score_names(rows), _differing(rows)
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["variant", "seed", *names, "paper_psnr", "seconds_per_step", "steps", "parameters", *settings, "failed"]
        )
        for row in rows:
            for trial in row.trials:
                result = row.results.get(trial.seed)
                scores = own_scores(result) if result else {}
                cells = [_rounded(scores.get(name)) for name in names] + [row.paper]
                for name in ("seconds_per_step", "steps", "parameters"):
                    cells.append(result[name] if result else None)
                cells += [_settings(result).get(name) if result else None for name in settings]
                writer.writerow([row.variant, trial.seed, *cells, row.failed.get(trial.seed)])
            columns = [list(row.scores(name).values()) for name in names]
            empty = [None] * (len(settings) + 4)
            writer.writerow(
                [
                    row.variant,
                    "mean",
                    *(_rounded(statistics.mean(c)) if c else None for c in columns),
                    row.paper,
                    *empty,
                ]
            )
            spreads = (_rounded(statistics.stdev(c)) if len(c) > 1 else None for c in columns)
            writer.writerow([row.variant, "spread", *spreads, None, *empty])


def _settings(result: dict[str, Any]) -> dict[str, Any]:
    """Return the hyper-parameters that a checkpoint says it was trained with."""
    network = {name: value for name, value in flatten(result["network"]) if name != "class"}
    return {**network, **result["optimizer"]}


def _differing(rows: Sequence[Row]) -> list[str]:
    found = [_settings(result) for row in rows for result in row.results.values()]
    names = dict.fromkeys(name for settings in found for name in settings)
    return [name for name in names if any(settings.get(name) != found[0].get(name) for settings in found)]


def _others(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return the methods that were tested beside the networks and that scored the same in all trials."""
    found = [result for row in rows for result in row.results.values()]
    if not found:
        return {}
    networks = [result["method"] or "" for result in found]
    return {
        method: scores
        for method, scores in found[0]["metrics"].items()
        if not any(name and method.startswith(name) for name in networks)
        and all(result["metrics"].get(method) == scores for result in found)
    }


def _values(row: Row, of: Any) -> str:
    return ", ".join(dict.fromkeys(str(of(result)) for result in row.results.values()))


def _heading(name: str) -> str:
    metric, comma, rest = name.partition(",")
    return _STYLE.get(metric, (metric, 0))[0] + comma + rest


def _decimals(name: str) -> int:
    return _STYLE.get(name.partition(",")[0], ("", 4))[1]


def _mean(values: Any, decimals: int, sign: str = "") -> str:
    values = list(values)
    if not values:
        return ""
    spread = f" ± {statistics.stdev(values):.{decimals}f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):{sign}.{decimals}f}{spread}"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
