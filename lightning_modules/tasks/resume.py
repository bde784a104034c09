"""Resuming a training: a checkpoint that Lightning would fail on midway is rejected before training starts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from torch import Tensor

from lightning_modules.storage.checkpoint import read_checkpoint
from lightning_modules.tasks.base import BaseTask
from spikekit.arguments import one_line

_LARGEST = (1 << 63) - 1  # of the whole numbers that tensors hold


def check_resume(path: str | Path, module: BaseTask, trainer: Trainer) -> dict[str, Any]:
    """Read a checkpoint that training is to resume from, and compare all parts of it with a training that begins.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no checkpoint, or one that this training cannot resume from; the message is one line and names it.
    """
    checkpoint = read_checkpoint(path)
    try:
        _check(checkpoint, module, trainer)
    except Exception as error:  # what torch raises depends on the damage
        raise ValueError(f"{path}: training cannot resume from this checkpoint: {one_line(error)[:300]}") from error
    return checkpoint


def load_weights_of(checkpoint: Mapping[str, Any], path: str | Path, module: BaseTask) -> None:
    """Give a module the weights of a checkpoint.

    Raises:
        ValueError: weights of another network; the message is one line and names the file.
    """
    try:
        module.on_load_checkpoint(dict(checkpoint))
        module.load_state_dict(checkpoint["state_dict"])
    except (KeyError, RuntimeError) as error:
        raise ValueError(f"{path}: weights of another network: {one_line(error)[:300]}") from error


def _check(checkpoint: Mapping[str, Any], module: BaseTask, trainer: Trainer) -> None:
    begin = {"epoch": 0, "global_step": 0, "loops": {"fit_loop": trainer.fit_loop.state_dict()}}
    for name, value in begin.items():
        if name not in checkpoint:
            raise ValueError(f"expected {name}, got none")
        _compare(value, checkpoint[name], name)
    if "fit_loop" not in checkpoint["loops"]:
        raise ValueError("loops: expected fit_loop, got none")
    states = checkpoint.get("callbacks", {})
    for callback in trainer.callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.state_key in states:
            _compare(callback.state_dict(), states[callback.state_key], "callbacks")
    _check_optimizer(checkpoint, module)


def _check_optimizer(checkpoint: Mapping[str, Any], module: BaseTask) -> None:
    """Load the states of optimizer and schedule where nothing depends on them, and compare them after a step."""
    weights = [torch.nn.Parameter(weight.detach().clone()) for weight in module.network.parameters()]
    made = module.optimizers_of(weights)
    optimizer, schedule = made["optimizer"], made["lr_scheduler"]["scheduler"]
    groups = optimizer.state_dict()["param_groups"]
    if schedule.state_dict().keys() != checkpoint["lr_schedulers"][0].keys():
        raise ValueError(f"lr_schedulers: expected the state of {type(schedule).__name__}")
    _compare([schedule.state_dict()], checkpoint["lr_schedulers"], "lr_schedulers")
    for weight in weights:
        weight.grad = torch.zeros_like(weight)
    optimizer.step()
    fresh = optimizer.state_dict()["state"]
    [saved] = checkpoint["optimizer_states"]
    optimizer.load_state_dict(saved)  # it knows what older versions of torch did not write
    for own, group, loaded in zip(groups, saved["param_groups"], optimizer.param_groups, strict=True):
        _compare(own, group, "optimizer_states.param_groups")
        if lacking := own.keys() - loaded.keys():
            raise ValueError(f"optimizer_states.param_groups: expected {', '.join(sorted(lacking))}, got none")
    for key, values in saved["state"].items():
        if key not in fresh or not isinstance(values, dict) or values.keys() != fresh[key].keys():
            raise ValueError(f"optimizer_states: expected those of {type(optimizer).__name__} for weight {key!r:.80}")
        _compare(fresh[key], values, "optimizer_states")


def _compare(fresh: Any, value: Any, name: str) -> None:
    """Raise unless a value is of the kind that a training begins with; where that is empty, any plain value will do."""
    nothing = fresh is None or (isinstance(fresh, (dict, list, tuple)) and not fresh)
    number = type(value) in (int, float) and abs(value) <= _LARGEST
    if isinstance(value, Tensor):
        if not (value.numel() == 1 and nothing) and not (isinstance(fresh, Tensor) and value.shape == fresh.shape):
            raise TypeError(f"{name}: expected {_kind(fresh)}, got {_kind(value)}")
        begins_finite = isinstance(fresh, Tensor) and fresh.isfinite().all()  # the score of ModelCheckpoint does not
        if value.is_complex() or (begins_finite and not value.isfinite().all()):
            raise ValueError(f"{name}: expected finite numbers, got NaN, Inf or complex ones")
    elif isinstance(value, dict) and (nothing or isinstance(fresh, dict)):
        for key, inner in value.items():
            _compare((fresh or {}).get(key), inner, f"{name}.{key!s:.80}")
    elif isinstance(value, (list, tuple)) and (nothing or isinstance(fresh, (list, tuple))):
        for mine, theirs in zip(fresh or [None] * len(value), value, strict=True):
            _compare(mine, theirs, name)
    elif type(fresh) is int:
        least = min(fresh, 1)  # a count may begin at 0; a period, such as StepLR's, is never 0
        if not (type(value) is int and number and value >= least):
            raise ValueError(f"{name}: expected a whole number, {least} or more, got {value!s:.80}")
    elif type(fresh) is float:
        if not (number or (type(value) is float and not math.isfinite(fresh))):
            raise ValueError(f"{name}: expected a finite number, got {value!s:.80}")
    elif not (number or type(value) in (float, bool, str, type(None)) if nothing else type(fresh) is type(value)):
        raise TypeError(f"{name}: expected {_kind(fresh)}, got {_kind(value)}")


def _kind(value: Any) -> str:
    """What a message calls a value."""
    return (
        f"a tensor of shape {tuple(value.shape)}"
        if isinstance(value, Tensor)
        else f"{type(value).__name__} {value!s:.80}"
    )
