"""Training budgets of a sweep in steps, wall time or FLOPs; learning-rate schedules end with them."""

from __future__ import annotations

import re
from argparse import ArgumentTypeError
from copy import deepcopy
from typing import Any

#: arguments of learning-rate schedules for their last step
_ENDS = ("T_max", "total_steps")

_CONSTANT = {"class_path": "torch.optim.lr_scheduler.ConstantLR", "init_args": {"factor": 1.0}}
_PACE = {"class_path": "lightning_modules.tasks.pace.Pace", "init_args": {}}


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
