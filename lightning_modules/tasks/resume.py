"""Check that a training can resume from a checkpoint, before it starts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from lightning_modules.tasks.base import BaseTask
from spikekit.arguments import one_line


def check_resume(checkpoint: Mapping[str, Any], path: str | Path, module: BaseTask) -> None:
    """Check a checkpoint by one step with a temporary optimiser and schedule."""
    weights = [torch.nn.Parameter(weight.detach().clone()) for weight in module.network.parameters()]
    made = module.optimizers_of(weights)
    try:
        parts = {"optimizer_states": made["optimizer"], "lr_schedulers": made["lr_scheduler"]["scheduler"]}
        for name, part in parts.items():
            [state] = checkpoint[name]
            part.load_state_dict(state)
        for weight in weights:
            weight.grad = torch.zeros_like(weight)
        made["optimizer"].step()
        for name in ("epoch", "global_step", "loops"):
            checkpoint[name]
    except Exception as error:  # the type depends on the damage
        raise ValueError(f"{path}: training cannot resume from this checkpoint: {one_line(error)[:300]}") from error


def load_weights_of(checkpoint: Mapping[str, Any], path: str | Path, module: BaseTask) -> None:
    """Load the weights of a checkpoint into a module."""
    try:
        module.on_load_checkpoint(dict(checkpoint))
        module.load_state_dict(checkpoint["state_dict"])
    except (KeyError, RuntimeError) as error:
        raise ValueError(f"{path}: weights of another network: {one_line(error)[:300]}") from error
