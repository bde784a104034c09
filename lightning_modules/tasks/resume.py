"""Resuming a training: a checkpoint that Lightning would fail on midway is rejected before training starts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from lightning_modules.storage.checkpoint import read_checkpoint
from lightning_modules.tasks.base import BaseTask
from spikekit.arguments import one_line


def check_resume(path: str | Path, module: BaseTask) -> None:
    """Take a step from a checkpoint with an optimizer and a schedule on which nothing depends.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no checkpoint, or one that this training cannot resume from; the message is one line and names it.
    """
    checkpoint = read_checkpoint(path)
    weights = [torch.nn.Parameter(weight.detach().clone()) for weight in module.network.parameters()]
    made = module.optimizers_of(weights)
    try:
        for name, part in (
            ("optimizer_states", made["optimizer"]),
            ("lr_schedulers", made["lr_scheduler"]["scheduler"]),
        ):
            [state] = checkpoint[name]
            part.load_state_dict(state)
        for weight in weights:
            weight.grad = torch.zeros_like(weight)
        made["optimizer"].step()
        for name in ("epoch", "global_step", "loops"):
            checkpoint[name]
    except Exception as error:  # what torch raises depends on what is wrong
        raise ValueError(f"{path}: training cannot resume from this checkpoint: {one_line(error)[:300]}") from error


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
