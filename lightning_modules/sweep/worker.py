"""One trial in a separate process: ``python -m lightning_modules.sweep.worker FOLDER SECONDS``."""

from __future__ import annotations

import csv
import math
import shutil
import sys
import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import yaml
from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from torch.utils.flop_counter import FlopCounterMode

from lightning_modules.cli.command import Command, run
from lightning_modules.cli.errors import as_one_line
from lightning_modules.cli.processes import end_with_parent
from lightning_modules.storage.checkpoint import DivergedError, read_checkpoint
from lightning_modules.sweep.state import RESULT, check_result, read_settings, say_progress, write_json
from lightning_modules.sweep.trials import with_budget
from lightning_modules.tasks.pace import share_done
from spikekit.io.whole_file import write_whole

_A_MOMENT = 0.5  # seconds between two reports


class Report(Callback):
    """Write the progress of training to a file, and stop it if the loss is not finite."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.steps, self.seconds = 0, 0.0  # without validation; over all resumed runs

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        self._began = self._reported = time.monotonic()
        self._ended: float | None = None
        self._first, self._share = trainer.global_step, share_done(trainer)
        self._say(trainer)

    def on_train_batch_end(  # noqa: D102
        self, trainer: Trainer, module: LightningModule, outputs: dict[str, Any], *_: Any
    ) -> None:
        now = time.monotonic()
        if self._ended is not None:
            self.steps += 1 / trainer.accumulate_grad_batches
            self.seconds += now - self._ended
        self._ended, self._loss = now, outputs["loss"]
        if now - self._reported > _A_MOMENT:
            self._check(trainer)
            self._say(trainer)
            self._reported = now

    def on_validation_start(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        self._ended = None

    def on_train_end(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        if trainer.global_step > self._first:
            self._check(trainer)
        self._say(trainer)

    def on_test_start(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        say_progress(self.folder, "testing")
        self.parameters = sum(parameter.numel() for parameter in module.parameters())

    def state_dict(self) -> dict[str, Any]:  # noqa: D102
        return {"steps": self.steps, "seconds": self.seconds}

    def load_state_dict(self, state: dict[str, Any]) -> None:  # noqa: D102
        self.steps, self.seconds = state["steps"], state["seconds"]

    def _check(self, trainer: Trainer) -> None:
        if not math.isfinite(self._loss):
            raise DivergedError(f"the loss is {float(self._loss)} at step {trainer.global_step}")

    def _say(self, trainer: Trainer) -> None:
        share = share_done(trainer)
        words = [f"step {trainer.global_step}", f"{share:.0%}"]
        words += [f"{name} {value:.4g}" for name, value in trainer.callback_metrics.items() if name[:4] == "val/"]
        if share > self._share:
            left = (time.monotonic() - self._began) / (share - self._share) * (1 - share)
            words.append(f"{timedelta(seconds=round(left))} left")
        say_progress(self.folder, ", ".join(words))


class _Cost(Callback):
    """Count the FLOPs of training batches, without those of rendering clips."""

    flops = 0

    def on_train_batch_start(self, *_: Any) -> None:
        self._counter = FlopCounterMode(display=False)
        self._counter.__enter__()

    def on_train_batch_end(self, *_: Any) -> None:
        self._counter.__exit__(None, None, None)
        self.flops += self._counter.get_total_flops()


def _command(callbacks: list[Callback]) -> type[Command]:
    class TrialCommand(Command):
        def _callbacks(self, output: Path) -> list[Callback]:
            return [*super()._callbacks(output), *callbacks]

    return TrialCommand


def plan(folder: Path) -> Path:
    """Return the configuration file to train with: that of the trial, or one with a budget of FLOPs as steps.

    One training step is run to count its FLOPs (forward, backward and optimiser) with
    :class:`torch.utils.flop_counter.FlopCounterMode`: convolutions and matrix products, two per multiply-add, without
    elementwise operations such as the warp. A resumed trial keeps its first plan.
    """
    own, planned = folder / "trial.yaml", folder / "plan.yaml"
    config, budget = read_settings(own), read_settings(folder / "budget.json")
    if "flops" not in budget:
        return own
    if not planned.is_file():
        say_progress(folder, "measuring a step")
        cost = _Cost()
        batches = config["trainer"]["accumulate_grad_batches"]
        run(["fit", "-c", str(own), f"--trainer.fast_dev_run={batches}"], _command([cost]))
        count = int(budget["flops"] / max(1, cost.flops))
        if count < 1:
            raise SystemExit(
                f"lightning: a step takes {cost.flops:.3g} FLOPs, more than the budget {budget['flops']:.3g}"
            )
        text = yaml.safe_dump(with_budget(config, {"steps": count}), sort_keys=False)
        write_whole(planned, f"# a step: {cost.flops:.6g} FLOPs\n{text}")
    return planned


def train_and_test(folder: Path, every: float) -> None:
    """Train a trial, or resume it, and test its last weights."""
    config = plan(folder)
    report = Report(folder)
    checkpoints = folder / "checkpoints"
    last = checkpoints / "last.ckpt"
    if not last.is_file():  # stopped before the first checkpoint
        shutil.rmtree(checkpoints, ignore_errors=True)
    often = ModelCheckpoint(
        checkpoints, "last", train_time_interval=timedelta(seconds=every), enable_version_counter=False
    )
    resume = ["--ckpt_path", "last"] if last.is_file() else []
    run(["fit", "-c", str(config), *resume, "--trainer.enable_progress_bar=false"], _command([report, often]))
    run(["test", "-c", str(config), "--ckpt_path", "last", "--trainer.enable_progress_bar=false"], _command([report]))
    write_json(folder / RESULT, _result(folder, last, report))


def _result(folder: Path, last: Path, report: Report) -> dict[str, Any]:
    checkpoint = read_checkpoint(last)
    result = {
        "scores": _scores(folder / "test.csv", checkpoint["network"].get("class", "")),
        "steps": checkpoint["global_step"],
        "seconds_per_step": report.seconds / max(report.steps, 1),
        "parameters": report.parameters,
    }
    try:
        return check_result(result)
    except ValueError as error:
        raise DivergedError(f"the test: {error}") from error


def _scores(path: Path, network: str) -> dict[str, float]:
    """Return the mean scores of the network in a test; for a network for films, those of films."""
    if not path.is_file():
        return {}  # the module writes no table
    with open(path, newline="") as file:
        means = [row for row in csv.DictReader(file) if row["clip"] == "mean"]
    own = [row for row in means if row["method"] in (network, f"{network}, film")] or means
    return {name: float(value) for name, value in own[-1].items() if name not in ("method", "clip")}


if __name__ == "__main__":
    end_with_parent()
    arguments, sys.argv = sys.argv[1:], sys.argv[:1]
    with as_one_line():
        train_and_test(Path(arguments[0]), float(arguments[1]))
