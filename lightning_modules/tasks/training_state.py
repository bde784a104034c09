"""The training state in a checkpoint, checked before it is used, because Lightning would fail on it midway."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from pytorch_lightning import Callback, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from torch import Tensor

from spikekit.arguments import one_line

if TYPE_CHECKING:
    from pathlib import Path

    from lightning_modules.tasks.base import Learner


_MOST = (1 << 63) - 1


def check_training_state(checkpoint: Mapping[str, Any], path: str | Path) -> None:
    """Refuse a checkpoint that training cannot resume from, before anything is built.

    Args:
        checkpoint: as :func:`lightning_modules.storage.checkpoint.read_checkpoint` returns it.
        path: its file, for the message.

    Raises:
        ValueError: no state of the optimizer, the schedule or the loops, or a damaged one; the message is one line.
    """
    lacks = f"{path}: not a checkpoint that training can go on with: expected"
    for name in ("epoch", "global_step"):
        value = checkpoint.get(name)
        if type(value) is not int or value < 0:
            raise ValueError(f"{lacks} {name} as a whole number, got {str(value)[:80]!r}")
    for name, kind in (("optimizer_states", list), ("lr_schedulers", list), ("loops", dict)):
        value = checkpoint.get(name)
        if not isinstance(value, kind) or (kind is list and not all(isinstance(one, dict) for one in value)):
            raise ValueError(f"{lacks} {name}, got {'none' if value is None else type(value).__name__}")
    if not checkpoint["optimizer_states"] or not isinstance(checkpoint["loops"].get("fit_loop"), dict):
        raise ValueError(f"{lacks} the state of an optimizer and of the training loop, got none")
    for state in checkpoint["optimizer_states"]:
        if not isinstance(state.get("state"), dict) or not isinstance(state.get("param_groups"), list):
            raise ValueError(f"{lacks} state and param_groups of the optimizer")


def check_like_fresh(checkpoint: Mapping[str, Any], path: str | Path, model: Learner, trainer: Trainer) -> None:
    """Compare the state of a training with that of a fresh one, part by part.

    Args:
        checkpoint: as :func:`lightning_modules.storage.checkpoint.read_checkpoint` returns it, after
            :func:`check_training_state`.
        path: its file, for the message.
        model: what is to be trained.
        trainer: of it.

    Raises:
        ValueError: a state that does not fit; the message is one line and names the file.
    """
    with _naming(path):
        fresh = model.configure_optimizers()
        optimizer, scheduler = fresh["optimizer"], fresh["lr_scheduler"]["scheduler"]
        (state,), (schedule,) = checkpoint["optimizer_states"], checkpoint["lr_schedulers"]
        _check_like(scheduler.state_dict(), schedule, "lr_schedulers", known=True)
        groups = optimizer.state_dict()["param_groups"]
        for group, own in zip(state["param_groups"], groups, strict=True):
            _check_like(own, group, "optimizer_states.param_groups")
        _check_states(state, model)
        optimizer.load_state_dict(state)  # which knows what older versions of torch did not write
        for group, own in zip(optimizer.param_groups, groups, strict=True):
            if lacking := own.keys() - group.keys():
                raise ValueError(f"optimizer_states.param_groups: expected {', '.join(sorted(lacking))}, got none")
        _check_like(trainer.fit_loop.state_dict(), checkpoint["loops"]["fit_loop"], "loops")
        states = checkpoint.get("callbacks", {})
        for callback in trainer.callbacks:
            if isinstance(callback, ModelCheckpoint) and callback.state_key in states:
                _check_like(callback.state_dict(), states[callback.state_key], "callbacks")


@contextmanager
def restoring(path: str | Path | None, begun: Begun) -> Iterator[None]:
    """Say in one line that a checkpoint does not fit, where that ends a run before it has begun.

    Args:
        path: of the checkpoint; ``None`` where nothing is restored.
        begun: a callback of the trainer.

    Raises:
        ValueError: as above.
    """
    if path is None:
        yield
        return
    try:
        yield
    except (RuntimeError, LookupError, TypeError, AttributeError) as error:
        if begun:
            raise
        raise ValueError(f"{path}: not a checkpoint that fits ({one_line(error)[:300]})") from error


class Begun(Callback):
    """Is true once a run has restored what there is to restore."""

    _begun = False

    def __bool__(self) -> bool:
        return self._begun

    def _begin(self, *_: Any) -> None:
        self._begun = True

    on_train_start = on_validation_start = on_test_start = on_predict_start = _begin


@contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, RuntimeError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        said = f"not a checkpoint that training can go on with: {one_line(error)[:300]}"
        raise ValueError(f"{path}: {said}") from error


def _check_states(state: Mapping[str, Any], model: Learner) -> None:
    """Raise unless every weight has the states that the optimizer gives it in a step."""
    weights = [torch.nn.Parameter(weight.detach().clone()) for weight in model.network.parameters()]
    for weight in weights:
        weight.grad = torch.zeros_like(weight)
    optimizer = model.make_optimizer(weights)
    optimizer.step(lambda: torch.zeros(()))
    fresh = optimizer.state_dict()["state"]
    for key, values in state["state"].items():
        if not isinstance(values, dict) or values.keys() != fresh.get(key, {}).keys():
            raise ValueError(
                f"optimizer_states: expected those of {type(optimizer).__name__} for weight {str(key)[:80]}"
            )
        for name, value in values.items():
            _check_like(fresh[key][name], value, f"optimizer_states.{name}")
            if isinstance(value, Tensor) and not value.isfinite().all():
                raise ValueError(f"optimizer_states.{name}: expected finite numbers, got NaN or Inf")


def _check_like(fresh: Any, value: Any, name: str, known: bool = False) -> None:
    """Raise unless a value is of the kind of the one that a training begins with.

    Args:
        fresh: of a training that begins; None, and what is empty, may have become any plain value.
        value: to be checked.
        name: of it.
        known: refuse keys that are not in ``fresh``.
    """
    if isinstance(value, int) and abs(value) > _MOST:
        raise ValueError(f"{name}: expected a number of 64 bits, got more")
    if fresh is None or (isinstance(fresh, (dict, list)) and not fresh):
        _check_scalar(value, name)
    elif isinstance(fresh, dict):
        if not isinstance(value, dict):
            raise TypeError(f"{name}: expected names and values, got {type(value).__name__}")
        for key, inner in value.items():
            if key in fresh:
                _check_like(fresh[key], inner, f"{name}.{key}", known)
            elif known:
                raise ValueError(f"{name}: expected nothing called {str(key)[:80]!r}")
            else:
                _check_scalar(inner, f"{name}.{str(key)[:80]}")
    elif isinstance(fresh, (list, tuple)):
        if not isinstance(value, (list, tuple)) or len(value) != len(fresh):
            raise ValueError(f"{name}: expected {len(fresh)} values, got {str(value)[:80]}")
        for mine, theirs in zip(fresh, value, strict=True):
            _check_like(mine, theirs, name, known)
    elif isinstance(fresh, (bool, str)):
        if type(value) is not type(fresh):
            raise TypeError(f"{name}: expected a {type(fresh).__name__}, got {str(value)[:80]}")
    elif isinstance(fresh, int):
        least = min(fresh, 1)  # a count may begin at 0; a period, such as StepLR's, is never 0
        if type(value) is not int or value < least:
            raise TypeError(f"{name}: expected a whole number, {least} or more, got {str(value)[:80]}")
    elif isinstance(fresh, float):
        if type(value) not in (int, float) or (math.isfinite(fresh) and not math.isfinite(value)):
            raise TypeError(f"{name}: expected a finite number, got {str(value)[:80]}")
    elif isinstance(fresh, Tensor) and not (isinstance(value, Tensor) and value.shape == fresh.shape):
        raise TypeError(f"{name}: expected a tensor of shape {tuple(fresh.shape)}, got {str(value)[:80]}")


def _check_scalar(value: Any, name: str) -> None:
    """Raise unless a value is plain: a number, a text, nothing, a tensor of one number; or lists or names of such."""
    if isinstance(value, int) and abs(value) > _MOST:
        raise ValueError(f"{name}: expected a number of 64 bits, got more")
    if isinstance(value, (dict, list, tuple)):
        for one in value.values() if isinstance(value, dict) else value:
            _check_scalar(one, name)
    elif not (value is None or isinstance(value, (int, float, str)) or _is_number(value)):
        raise TypeError(f"{name}: expected a plain value, got {type(value).__name__}")


def _is_number(value: Any) -> bool:
    return isinstance(value, Tensor) and value.numel() == 1 and not value.is_complex()
