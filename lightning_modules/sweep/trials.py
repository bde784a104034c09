"""Trials of a sweep: all combinations with their names, resolved configurations and training budgets."""

from __future__ import annotations

import itertools
import json
import re
from argparse import ArgumentError, ArgumentTypeError
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from lightning_modules.cli.arguments import flatten
from lightning_modules.cli.command import Rehearsal, resolved, run
from lightning_modules.cli.errors import InputError, UsageError
from lightning_modules.cli.reasons import reason
from lightning_modules.sweep.state import read_settings, write_json
from spikekit.io.whole_file import write_whole
from spikekit.progress import progress

_LONGEST = 240  # bytes of a folder's name

#: arguments of learning-rate schedules for their last step
_ENDS = ("T_max", "total_steps")

_CONSTANT = {"class_path": "torch.optim.lr_scheduler.ConstantLR", "init_args": {"factor": 1.0}}
_PACE = {"class_path": "lightning_modules.tasks.pace.Pace", "init_args": {}}


@dataclass(frozen=True)
class Trial:
    """One training and its test."""

    labels: tuple[str, ...]  # overlay or value chosen from each group
    seed: int | None  # of the initial weights; None for that of the configuration
    folder: Path
    config: dict[str, Any]
    budget: dict[str, float]

    @property
    def variant(self) -> str:
        """Name of the variant, a row of the table; trials of one variant differ only in their seeds."""
        return "-".join(self.labels)

    def write(self) -> None:
        """Write configuration and budget to the folder, which must not hold another trial."""
        config, budget = self.folder / "trial.yaml", self.folder / "budget.json"
        if budget.is_file():  # written last
            there = {**read_settings(config), "budget": read_settings(budget)}
            asked = {**yaml.safe_load(yaml.safe_dump(self.config)), "budget": self.budget}
            if there != asked:
                raise InputError(f"{self.folder}: {_difference(there, asked)}; choose another -o, or delete the folder")
        elif self.folder.is_dir() and any(path != config for path in self.folder.iterdir()):
            raise InputError(f"{self.folder}: is not empty, and holds no trial; choose another -o")
        else:
            write_whole(config, yaml.safe_dump(self.config, sort_keys=False))
            write_json(budget, self.budget)


def make_trials(
    configs: Sequence[str],
    over: Sequence[Sequence[str]],
    settings: Sequence[str],
    seeds: Sequence[int],
    budget: dict[str, float],
    output: Path,
) -> list[Trial]:
    """Parse and build all combinations of overlays, one of each group, and values; nothing is written."""
    common = [word for config in configs for word in ("-c", str(config))]
    groups = [[(Path(path).stem, ["-c", str(path)]) for path in group] for group in over]
    for key, values in map(_key_and_values, settings):
        choices = [[f"--{key}={value}"] for value in values]
        if len(choices) == 1:  # the same for all, so not part of the names
            common += choices[0]
        else:
            short = key.rpartition(".")[2]
            groups.append([(f"{short}={value}", choice) for value, choice in zip(values, choices, strict=True)])
    base = _resolve(common, "")
    trials = []
    for combination in progress(list(itertools.product(*groups)), "combinations built"):
        labels = tuple(label for label, _ in combination) or (Path(configs[-1]).stem,)
        args = [*common, *(word for _, words in combination for word in words)]
        config = _resolve(args, f"{'-'.join(labels)}: ") if combination else base
        for seed in seeds or [None]:
            name = "-".join(labels) + ("" if seed is None else f"-seed{seed}")
            # a valid name: file systems allow 255 bytes; the end of a long one, with its seed, is kept
            folder = output / re.sub(r"[^\w.=+-]+", "_", name, flags=re.ASCII)[-_LONGEST:]
            own = {} if seed is None else {"seed_everything": seed}
            resolved = with_budget({**config, **own, "output": str(folder)}, budget)
            trials.append(Trial(labels, seed, folder, resolved, budget))
    folders = [trial.folder for trial in trials]
    twice = next((folder for folder in folders if folders.count(folder) > 1), None)
    if twice:
        raise UsageError(f"two trials have the name {twice.name}: expected different names, values and seeds")
    _check_differences(trials)
    return trials


def _check_differences(trials: Sequence[Trial]) -> None:
    seen: dict[str, Trial] = {}
    for trial in trials:
        what = json.dumps({**trial.config, "output": None}, sort_keys=True)
        other = seen.setdefault(what, trial)
        if other is not trial:
            weights = trial.config["model"]["init_args"].get("weights")
            why = f"; the network of model.weights={weights} overrides that of overlays" if weights else ""
            names = f"{other.folder.name} and {trial.folder.name}"
            raise UsageError(f"sweep: expected different trials, got the same settings for {names}{why}")


def _key_and_values(setting: str) -> tuple[str, list[str]]:
    """Split a setting into key and values, at commas outside brackets."""
    key, equals, values = setting.partition("=")
    split = re.findall(r"(?:[^,\[{]|\[.*?\]|\{.*?\})+", values)
    if not (key and equals and split):
        raise UsageError(f"--set: expected KEY=VALUE,VALUE,..., such as model.network.width=16,32, got {setting}")
    if key == "output":
        raise UsageError(f"--set: expected the folder of the sweep as -o DIR, got {setting}")
    return key.removeprefix("--"), split


class _Resolver(Rehearsal):
    verb = "fit"

    def _set_seed(self) -> None:
        pass

    def before_instantiate_classes(self) -> None:
        path = self.config[self.verb].ckpt_path
        if path:
            instead = "as trials resume from their own; model.weights=FILE sets initial weights"
            raise UsageError(f"ckpt_path: expected none, {instead}, got {path}")

    def instantiate_trainer(self, **kwargs: Any) -> None:
        """Build no trainer, as the training may run on another machine."""


def _resolve(args: Sequence[str], trial: str) -> dict[str, Any]:
    try:
        command = run(["fit", *args], _Resolver)
    except (ArgumentError, InputError) as error:
        kind = InputError if isinstance(error, InputError) and not isinstance(error, UsageError) else UsageError
        raise kind(trial + reason(str(error))) from error
    config = resolved(command)
    if config["trainer"]["devices"] not in ("auto", 1, "1"):
        raise UsageError(f"{trial}trainer.devices: expected 1 for a trial, got {config['trainer']['devices']}")
    config["trainer"]["devices"] = 1
    # not part of the trial
    return {key: value for key, value in config.items() if key not in ("ckpt_path", "weights_only")}


def _difference(there: dict[str, Any], asked: dict[str, Any]) -> str:
    there, asked = dict(flatten(there)), dict(flatten(asked))
    key = min((key for key in {**there, **asked} if there.get(key) != asked.get(key)), default="its form")
    holds, wanted = (" ".join(str(values.get(key, "none")).split())[:80] for values in (there, asked))
    shown = " ".join(key.replace(".init_args", "").split())[:80]
    return f"holds a trial with {shown}={holds}, expected {wanted} for this sweep"


def seconds(text: str) -> float:
    """Parse a time above 0, ``HH:MM:SS`` or ``DD:HH:MM:SS``; raise ``ArgumentTypeError`` for anything else."""
    if not re.fullmatch(r"(\d+:)?\d+:[0-5]?\d:[0-5]?\d", text):
        raise ArgumentTypeError(f"expected HH:MM:SS or DD:HH:MM:SS, got {text}")
    time = sum(int(part) * unit for part, unit in zip(text.split(":")[::-1], (1, 60, 3600, 86400), strict=False))
    if time == 0:
        raise ArgumentTypeError(f"expected a time above 0, got {text}")
    return time


def with_budget(config: dict[str, Any], budget: dict[str, float]) -> dict[str, Any]:
    """Return a configuration of ``lightning fit`` with a training budget.

    The budget is empty, for that of the configuration, or ``steps``, or ``seconds`` of wall time including validation,
    or ``flops``, which :mod:`lightning_modules.sweep.worker` converts to steps. With ``steps``, a schedule with an end,
    such as ``CosineAnnealingLR``, ends at the last step. With ``seconds``, :class:`lightning_modules.tasks.pace.Pace`
    replaces it; its cosine ends with the time.
    """
    if not budget:
        return config
    config = deepcopy(config)
    steps, time = budget.get("steps"), budget.get("seconds")
    config["trainer"] |= {"max_epochs": -1, "max_steps": steps or -1, "max_time": time and {"seconds": time}}
    schedule = config["model"].get("init_args", {}).get("lr_scheduler")
    arguments = schedule.get("init_args", {}) if isinstance(schedule, dict) else {}
    for name in [name for name in _ENDS if arguments.get(name) is not None]:
        if steps:
            arguments[name] = steps
        if time:
            config["model"]["init_args"]["lr_scheduler"] = _CONSTANT
            config["trainer"]["callbacks"] = [*(config["trainer"]["callbacks"] or []), _PACE]
    return config
