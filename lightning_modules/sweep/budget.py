"""Training budgets of a sweep, in steps, wall time or FLOPs, with a schedule that ends with them."""

from __future__ import annotations

import re
from copy import deepcopy
from typing import Any

#: arguments of learning-rate schedules that say at which step they end
_ENDS = ("T_max", "total_steps")

_CONSTANT = {"class_path": "torch.optim.lr_scheduler.ConstantLR", "init_args": {"factor": 1.0}}
_PACE = {"class_path": "lightning_modules.tasks.pace.Pace", "init_args": {}}


def seconds(text: str) -> float:
    """Read a time, ``HH:MM:SS`` or ``DD:HH:MM:SS``; ``ValueError`` where it is not one, or no time at all."""
    if not re.fullmatch(r"(\d+:)?\d+:[0-5]?\d:[0-5]?\d", text):
        raise ValueError(f"expected HH:MM:SS or DD:HH:MM:SS, got {text}")
    time = sum(int(part) * unit for part, unit in zip(text.split(":")[::-1], (1, 60, 3600, 86400), strict=False))
    if time == 0:
        raise ValueError(f"expected more than no time, got {text}")
    return time


def with_budget(config: dict[str, Any], budget: dict[str, float]) -> dict[str, Any]:
    """Return a configuration of ``lightning fit`` that trains as long as a budget says.

    The budget is nothing, for what the configuration says; or ``steps``; or ``seconds``, in which training stops,
    validation included; or ``flops``, of which :mod:`lightning_modules.sweep.worker` makes steps once it has counted
    those of one. Steps are also those at which a schedule ends that has an end, such as ``CosineAnnealingLR``; where
    time is given, :class:`lightning_modules.tasks.pace.Pace` takes its place, whose cosine ends with the time.
    """
    if not budget:
        return config
    config = deepcopy(config)
    steps, time = budget.get("steps"), budget.get("seconds")
    config["trainer"] |= {"max_epochs": -1, "max_steps": steps or -1, "max_time": time and _duration(time)}
    for name in _ends(config):
        if steps:
            config["model"]["init_args"]["lr_scheduler"]["init_args"][name] = steps
        if time:
            config["model"]["init_args"]["lr_scheduler"] = _CONSTANT
            config["trainer"]["callbacks"] = [*(config["trainer"]["callbacks"] or []), _PACE]
    return config


def _duration(time: float) -> str:
    hours, time = divmod(round(time), 3600)
    return f"{hours // 24:02}:{hours % 24:02}:{time // 60:02}:{time % 60:02}"


def _ends(config: dict[str, Any]) -> list[str]:
    """Return which arguments of a configuration's schedule say at which step it ends."""
    schedule = config["model"].get("init_args", {}).get("lr_scheduler")
    arguments = schedule.get("init_args", {}) if isinstance(schedule, dict) else {}
    return [name for name in _ENDS if arguments.get(name) is not None]
