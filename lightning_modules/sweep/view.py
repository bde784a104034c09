"""Progress of a sweep: a live view on a terminal, a line per event elsewhere."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Sequence
from typing import Any

from lightning_modules.sweep.state import PROGRESS, RESULT, read_json
from lightning_modules.sweep.table import own_scores
from lightning_modules.sweep.trials import Trial

_EVERY = 60  # seconds between two lines about a trial, where there is no terminal


class View:
    """Show how far trials are.

    Args:
        trials: all of the sweep.
        failed: grows while it runs: why trials failed, by folder.
    """

    def __init__(self, trials: Sequence[Trial], failed: dict[Any, str]) -> None:
        self.trials, self.failed = trials, failed
        self.width = max(len(trial.folder.name) for trial in trials)
        self.live = sys.stdout.isatty()
        self._drawn = 0
        self._said = dict.fromkeys((trial.folder for trial in trials), 0.0)
        self._began = time.monotonic()
        self._share = sum(map(self._done, trials))

    def ended(self, trial: Trial) -> None:
        """Say once how a trial ended."""
        why = self.failed.get(trial.folder)
        if why is None:
            scores = own_scores(read_json(trial.folder / RESULT))
            what = "done, " + _scores({name: value for name, value in scores.items() if "," not in name})
        else:
            what = f"FAILED: {why} ({trial.folder / 'log.txt'})"
        self._print(f"{trial.folder.name:{self.width}}  {what}")

    def draw(self) -> None:
        """Show how far the trials are that are running."""
        running = [(trial, progress) for trial in self.trials if (progress := self._progress(trial)) is not None]
        if self.live:
            columns = shutil.get_terminal_size().columns - 1
            lines = [f"{trial.folder.name:{self.width}}  {_standing(progress)}" for trial, progress in running]
            lines.append(self._summary(len(running)))
            self._clear()
            print(*(line[:columns] for line in lines), sep="\n", flush=True)  # noqa: T201
            self._drawn = len(lines)
            return
        for trial, progress in running:
            if time.monotonic() - self._said[trial.folder] > _EVERY:
                self._said[trial.folder] = time.monotonic()
                self._print(f"{trial.folder.name:{self.width}}  {_standing(progress)}  [{self._summary(len(running))}]")

    def close(self) -> None:
        """Take the view away; the lines about trials that ended stay."""
        self._clear()

    def _print(self, line: str) -> None:
        self._clear()
        print(line, flush=True)  # noqa: T201

    def _clear(self) -> None:
        if self._drawn:
            print(f"\x1b[{self._drawn}A\x1b[J", end="")  # noqa: T201
            self._drawn = 0

    def _over(self, trial: Trial) -> bool:
        return trial.folder in self.failed or (trial.folder / RESULT).is_file()

    def _progress(self, trial: Trial) -> dict[str, Any] | None:
        return None if self._over(trial) else read_json(trial.folder / PROGRESS)

    def _done(self, trial: Trial) -> float:
        return 1.0 if self._over(trial) else (self._progress(trial) or {}).get("share") or 0.0

    def _summary(self, running: int) -> str:
        done = sum((trial.folder / RESULT).is_file() for trial in self.trials)
        share = sum(map(self._done, self.trials))
        passed, gained = time.monotonic() - self._began, share - self._share
        left = f", {_duration(passed / gained * (len(self.trials) - share))} left" if gained > 0.1 else ""
        failed = f", {len(self.failed)} failed" if self.failed else ""
        return f"{done} of {len(self.trials)} trials done{failed}, {running} running{left}"


def _standing(progress: dict[str, Any]) -> str:
    phase = progress["phase"]
    if phase != "training":
        return phase
    step, steps, rate, share, val = (progress.get(name) for name in ("step", "steps", "rate", "share", "val"))
    parts = [f"step {step}/{steps}" if steps else f"step {step}"]
    if rate:
        parts.append(f"{rate:.3g} it/s")
    if val:
        parts.append(_scores(val))
    if rate and steps:
        parts.append(f"{_duration((steps - (step or 0)) / rate)} left")
    elif share:
        parts.append(f"{share:.0%}")
    return ", ".join(parts)


def _scores(scores: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in scores.items())


def _duration(seconds: float) -> str:
    if not math.isfinite(seconds):
        return "?"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
