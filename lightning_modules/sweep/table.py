"""The table of a sweep, with one row per variant, averaged over seeds."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lightning_modules.metrics.image import Measure, measures
from lightning_modules.sweep.state import read_result
from lightning_modules.sweep.trials import Trial
from spikekit.io.whole_file import whole_file
from spikekit.tables import table

_COLUMNS = "steps", "seconds_per_step", "parameters"


@dataclass
class VariantResults:
    """A variant, its trials with one seed each, and their results or reasons of failure, by seed."""

    labels: tuple[str, ...]
    trials: list[Trial] = field(default_factory=list)
    results: dict[int | None, dict[str, Any]] = field(default_factory=dict)
    failed: dict[int | None, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the variant."""
        return self.trials[0].variant

    def scores(self, name: str) -> dict[int | None, float]:
        """Return a score by seed, for the tests that have it."""
        return {seed: result["scores"][name] for seed, result in self.results.items() if name in result["scores"]}


def collect(trials: Sequence[Trial], failed: dict[Path, str]) -> list[VariantResults]:
    """Collect the results so far, in the order of the trials."""
    rows: dict[tuple[str, ...], VariantResults] = {}
    for trial in trials:
        row = rows.setdefault(trial.labels, VariantResults(trial.labels))
        row.trials.append(trial)
        result = read_result(trial.folder)
        if result:
            row.results[trial.seed] = result
        elif trial.folder in failed:
            row.failed[trial.seed] = failed[trial.folder]
    return list(rows.values())


def reference(row: VariantResults, rows: Sequence[VariantResults]) -> VariantResults:
    """Return the row to compare with: the same variant with overlay J, or the first row."""
    full = [(*row.labels[:place], "j", *row.labels[place + 1 :]) for place in range(len(row.labels))]
    return next((other for other in rows if other.labels in full), rows[0])


def markdown(rows: Sequence[VariantResults]) -> str:
    """Return the table as Markdown."""
    known = {measure.name: measure for measure in measures()}
    scores = [known.get(name, Measure(name, name, 4, None)) for name in _score_names(rows)]
    compared = {reference(row, rows).name for row in rows}
    versus = compared.pop() if len(compared) == 1 else "reference"
    lines = []
    for row in rows:
        cells = {
            "variant": row.name,
            "n": f"{len(row.results)}" + (f", {len(row.failed)} failed" if row.failed else ""),
        }
        for score in scores:
            cells[score.heading] = _mean(row.scores(score.name).values(), score.digits)
        for score in scores[:1]:
            other, ours = reference(row, rows), row.scores(score.name)
            theirs = {} if other is row else other.scores(score.name)
            gaps = [ours[seed] - theirs[seed] for seed in ours if seed in theirs]
            cells[f"{score.heading} - {versus}"] = _mean(gaps, score.digits, "+")
        for name, heading, factor in zip(_COLUMNS, ("steps", "ms/step", "parameters"), (1, 1000, 1), strict=True):
            cells[heading] = _mean([factor * result[name] for result in row.results.values()], 0)
        lines.append(cells)
    text = [table(list(lines[0]), [list(cells.values()) for cells in lines])]
    text.append("Means over seeds ± sample standard deviation; differences per seed. The last weights are tested.")
    text += [
        f"{row.name}{'' if seed is None else f', seed {seed}'}, failed: {why}"
        for row in rows
        for seed, why in row.failed.items()
    ]
    unfinished = sum(len(row.trials) - len(row.results) - len(row.failed) for row in rows)
    text += [f"Not finished: {unfinished} trials."] if unfinished else []
    return "\n\n".join(text) + "\n"


def write_csv(rows: Sequence[VariantResults], path: Path) -> None:
    """Write all trials, and the mean and the spread of every variant."""
    names = _score_names(rows)
    with whole_file(path, "w", newline="") as file:
        writer = csv.DictWriter(file, ["variant", "seed", *names, *_COLUMNS, "failed"])
        writer.writeheader()
        for row in rows:
            for trial in row.trials:
                cells = {"variant": row.name, "seed": trial.seed, "failed": row.failed.get(trial.seed)}
                if result := row.results.get(trial.seed):
                    cells |= _rounded(result["scores"]) | {name: result[name] for name in _COLUMNS}
                writer.writerow(cells)
            found = {name: list(row.scores(name).values()) for name in names}
            means = {name: np.mean(values) for name, values in found.items() if values}
            writer.writerow({"variant": row.name, "seed": "mean", **_rounded(means)})
            spreads = {name: np.std(values, ddof=1) for name, values in found.items() if len(values) > 1}
            writer.writerow({"variant": row.name, "seed": "spread", **_rounded(spreads)})


def _score_names(rows: Sequence[VariantResults]) -> list[str]:
    """Return the names of all scores; variants are compared by the first."""
    return list(dict.fromkeys(name for row in rows for result in row.results.values() for name in result["scores"]))


def _mean(values: Iterable[float], digits: int, sign: str = "") -> str:
    """Return the mean and, for several values with decimal places, their spread."""
    values = list(values)
    if not values:
        return ""
    spread = f" ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 and digits else ""
    return f"{np.mean(values):{sign},.{digits}f}{spread}"


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(float(value), 4) for name, value in values.items()}
