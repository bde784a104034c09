"""The table of a sweep, in the form of the paper's Tables 2 and 3: a row a variant, seeds averaged."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lightning_modules.cli.arguments import flatten
from lightning_modules.sweep.paper import TABLE_2, TABLE_3, Scores, method_of
from lightning_modules.sweep.state import RESULT, read_json
from lightning_modules.sweep.trials import Trial
from spikekit.io.whole_file import whole_file
from spikekit.tables import table

#: how metrics are written in a table: heading and decimals
_STYLE = {"psnr": ("PSNR (dB)", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 4)}

#: what a frame costs: heading and format
_COSTS = {"ms": ("ms a frame", ".4g"), "mib": ("MiB", ".4g"), "macs": ("MAC a pixel", ",.0f")}

#: what Table 2 calls the network that the others are compared with
_OURS = "CSCSR"


@dataclass
class VariantResults:
    """A variant and the results of its trials.

    Args:
        trials: of one variant, a seed each.
        results: of those that are finished, by seed.
        failed: why others failed, by seed.
        compared: methods of the paper's Table 2 stand beside it, so that it is a row of that table itself.
    """

    trials: list[Trial]
    results: dict[int | None, dict[str, Any]] = field(default_factory=dict)
    failed: dict[int | None, str] = field(default_factory=dict)
    compared: bool = False

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
    def method(self) -> str | None:
        """The network's name in the paper's Table 2; None where it has no row there, such as an ablation."""
        found = {method_of(result["network"]) for result in self.results.values()}
        return found.pop() if len(found) == 1 and self.trials[0].letter in ("", "J") else None

    @property
    def paper(self) -> float | None:
        """PSNR on REDS that the paper reports for it, in Table 3 or, beside other methods, in Table 2."""
        letter = self.trials[0].letter
        if letter:
            return TABLE_3.get(self._scale, {}).get(letter)
        return self.paper_scores["REDS"].psnr if self.paper_scores else None

    @property
    def paper_scores(self) -> dict[str, Scores]:
        """Scores of the paper's Table 2 by data set, where other methods stand beside it."""
        return TABLE_2.get(self._scale, {}).get(self.method or "", {}) if self.compared else {}

    @property
    def paper_gap(self) -> float | None:
        """How far that is above CSCSR, the full network, in the same table."""
        return None if self.paper is None else self.paper - TABLE_3[self._scale]["J"]

    @property
    def _scale(self) -> int | None:
        scales = {result["network"].get("scale") for result in self.results.values()}
        return scales.pop() if len(scales) == 1 else None


def own_scores(result: dict[str, Any]) -> dict[str, float]:
    """Return the scores of the trained network; ``psnr, true flow`` and the like for its other rows of the test."""
    metrics, method = result["metrics"], result.get("method")
    if method not in metrics:
        method = next(iter(metrics), "")
    scores = dict(metrics.get(method, {}))
    for other, values in metrics.items():
        if other.startswith(f"{method}, "):
            scores |= {f"{name}{other.removeprefix(method)}": value for name, value in values.items()}
    return scores


def score_names(rows: Sequence[VariantResults]) -> list[str]:
    """Return what was measured, the first of it what variants are compared by."""
    return list(dict.fromkeys(name for row in rows for result in row.results.values() for name in own_scores(result)))


def collect(trials: Sequence[Trial], failed: dict[Path, str]) -> list[VariantResults]:
    """Collect the results so far, in the order of the trials."""
    rows: dict[str, VariantResults] = {}
    for trial in trials:
        row = rows.setdefault(trial.variant, VariantResults([]))
        row.trials.append(trial)
        result = read_json(trial.folder / RESULT)
        if result:
            row.results[trial.seed] = result
        elif trial.folder in failed:
            row.failed[trial.seed] = failed[trial.folder]
    compared = any(row.method not in (None, _OURS) for row in rows.values())
    for row in rows.values():
        row.compared = compared
    return list(rows.values())


def reference(row: VariantResults, rows: Sequence[VariantResults]) -> VariantResults:
    """Return the row that another is compared with: J or else, among other methods, CSCSR, with all else the same.

    Where there is none, it is the first.
    """
    for name in ("J", _OURS):
        for place in range(len(row.labels)):
            for other in rows:
                rest = other.labels[:place] + other.labels[place + 1 :]
                found = other.labels[place].upper() == name or (other.compared and other.method == name)
                if found and rest == row.labels[:place] + row.labels[place + 1 :]:
                    return other
    return rows[0]


def differences(row: VariantResults, other: VariantResults, name: str) -> list[float]:
    """Return how much better a row scores than another, seed by seed; of the means, where they share no seed."""
    ours, theirs = row.scores(name), other.scores(name)
    shared = [seed for seed in ours if seed in theirs]
    if not shared and ours and theirs:
        return [statistics.mean(ours.values()) - statistics.mean(theirs.values())]
    return [ours[seed] - theirs[seed] for seed in shared]


def markdown(rows: Sequence[VariantResults], costs: dict[str, Any] | None = None) -> str:
    """Return the table as Markdown.

    Args:
        rows: of the sweep.
        costs: as :func:`lightning_modules.sweep.cost.measure_variants` returns them; not known before the end.
    """
    names = score_names(rows)
    names = [name for name in names if "," not in name or name.startswith(names[0])]
    settings = [name for name in _differing(rows) if all(name in _settings(result) for result in _results(rows))]
    papers = any(row.paper is not None for row in rows)
    compared = list(dict.fromkeys(reference(row, rows).variant for row in rows))
    versus = compared[0] if len(compared) == 1 else "reference"
    data = list(dict.fromkeys(name for row in rows for name in row.paper_scores))
    lines = []
    for row in rows:
        count = f"{len(row.results)}" + (f", {len(row.failed)} failed" if row.failed else "")
        cells = {"variant": row.variant, "n": count}
        cells |= {_heading(name): _mean(row.scores(name).values(), _decimals(name)) for name in names}
        if names:
            other = reference(row, rows)
            gaps = differences(row, other, names[0]) if other is not row else []
            cells[f"{_heading(names[0])} - {versus}"] = _mean(gaps, _decimals(names[0]), "+")
        if papers:
            gap = row.paper_gap
            cells["paper, PSNR on REDS (dB)"] = "" if gap is None else f"{row.paper:.2f}"
            cells[f"paper - {_OURS if data else 'J'}"] = "" if gap is None else f"{gap:+.2f}"
        if data:
            cells["method"] = row.method or ""
            cells |= {f"paper, {name}: PSNR / SSIM / LPIPS": str(row.paper_scores.get(name, "")) for name in data}
        times = [result["seconds_per_step"] for result in row.results.values() if result.get("seconds_per_step")]
        cells["ms/step"] = f"{1000 * statistics.mean(times):.0f}" if times else ""
        cells["steps"] = _values(row, lambda result: result["steps"])
        cells["parameters"] = _values(row, lambda result: f"{result['parameters']:,}")
        if costs:
            cost = costs["variants"].get(row.variant, {})
            for name, (heading, form) in _COSTS.items():
                cells[heading] = f"{cost[name]:{form}}" if cost.get(name) is not None else ""
        for name in settings:
            cells[f"`{name}`"] = _values(row, lambda result, name=name: _settings(result).get(name, ""))
        lines.append(cells)
    text = [table(list(lines[0]), [list(cells.values()) for cells in lines]), ""]
    text.append(
        "Means over seeds ± sample standard deviation; differences seed by seed. The weights tested are the last."
    )
    if data:
        text.append("\nThe paper's clips are others: what can be compared is how far the methods are apart.")
    if costs and costs["where"]:
        text.append(f"\nTime, memory and multiplications, those of convolutions and matrices: {costs['where']}.")
    for row in rows:
        for seed, why in row.failed.items():
            text.append(f"\n{row.variant}{'' if seed is None else f', seed {seed}'}, failed: {why}")
    unfinished = sum(len(row.trials) - len(row.results) - len(row.failed) for row in rows)
    text += [f"\nNot finished: {unfinished} trials."] if unfinished else []
    for method, scores in _others(rows).items():
        text.append(f"\n{method} on the same clips: " + ", ".join(f"{k.upper()} {v:.4g}" for k, v in scores.items()))
    return "\n".join(text) + "\n"


def write_csv(rows: Sequence[VariantResults], path: Path, costs: dict[str, Any] | None = None) -> None:
    """Write every trial, and the mean, the spread and the costs of every variant.

    Args:
        rows: of the sweep.
        path: of the file.
        costs: as :func:`markdown` takes them.
    """
    names, settings = score_names(rows), _differing(rows)
    data = list(dict.fromkeys(name for row in rows for name in row.paper_scores))
    papers = [f"paper_{name}_{score}".lower() for name in data for score in Scores._fields]
    measured = list(_COSTS) if costs else []
    columns = ["variant", "seed", *names, "paper_psnr", "seconds_per_step", "steps", "parameters", *settings, "failed"]
    with whole_file(path, "w", newline="") as file:
        writer = csv.DictWriter(file, columns + ["method", *papers] * bool(data) + measured)
        writer.writeheader()
        for row in rows:
            paper = [score for name in data for score in row.paper_scores.get(name, (None,) * 3)]
            shared = {"variant": row.variant, "paper_psnr": row.paper, **dict(zip(papers, paper, strict=True))}
            shared |= {"method": row.method} if data else {}
            for trial in row.trials:
                cells = {"seed": trial.seed, "failed": row.failed.get(trial.seed)}
                result = row.results.get(trial.seed)
                if result:
                    scores = own_scores(result)
                    cells |= {name: _rounded(scores.get(name)) for name in names}
                    cells |= {name: result.get(name) for name in ("seconds_per_step", "steps", "parameters")}
                    cells |= {name: _settings(result).get(name) for name in settings}
                writer.writerow({**shared, **cells})
            found = {name: list(row.scores(name).values()) for name in names}
            means = {name: _rounded(statistics.mean(values)) for name, values in found.items() if values}
            cost = {name: costs["variants"].get(row.variant, {}).get(name) for name in measured}
            writer.writerow({**shared, "seed": "mean", **means, **cost})
            spreads = {name: _rounded(statistics.stdev(values)) for name, values in found.items() if len(values) > 1}
            writer.writerow({"variant": row.variant, "seed": "spread", **spreads})


def _settings(result: dict[str, Any]) -> dict[str, Any]:
    """Return the hyper-parameters that a checkpoint says it was trained with."""
    network = {name: value for name, value in flatten(result["network"]) if name != "class"}
    return {**network, **result["optimizer"]}


def _results(rows: Sequence[VariantResults]) -> list[dict[str, Any]]:
    return [result for row in rows for result in row.results.values()]


def _differing(rows: Sequence[VariantResults]) -> list[str]:
    found = [_settings(result) for result in _results(rows)]
    names = dict.fromkeys(name for settings in found for name in settings)
    return [name for name in names if any(settings.get(name) != found[0].get(name) for settings in found)]


def _others(rows: Sequence[VariantResults]) -> dict[str, dict[str, float]]:
    """Return the methods that were tested beside the networks and that scored the same in all trials."""
    found = _results(rows)
    if not found:
        return {}
    networks = [result.get("method") or "" for result in found]
    return {
        method: scores
        for method, scores in found[0]["metrics"].items()
        if not any(name and method.startswith(name) for name in networks)
        and all(result["metrics"].get(method) == scores for result in found)
    }


def _values(row: VariantResults, of: Any) -> str:
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
