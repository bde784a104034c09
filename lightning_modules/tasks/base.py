"""Base class of the LightningModules: optimiser, schedule, checkpoints with settings, and checks before a resume."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from pytorch_lightning import Callback, LightningModule
from pytorch_lightning.cli import LRSchedulerCallable, OptimizerCallable
from torch import nn

from lightning_modules.networks.network import read_network
from lightning_modules.storage.checkpoint import read_checkpoint
from lightning_modules.storage.pretrained import check_settings, motion_of, settings_of
from spikekit.arguments import one_line


def step_schedule(optimizer: torch.optim.Optimizer) -> torch.optim.lr_scheduler.StepLR:
    """Return the schedule of the paper: times 0.8 every 7500 steps."""
    return torch.optim.lr_scheduler.StepLR(optimizer, 7500, 0.8)


class BaseTask(LightningModule):
    """Base of the LightningModules.

    Args:
        network: network to train; its ``settings`` are its constructor arguments as plain values.
        needs: required values of data options, by name.
        flow_times: spike frames between which the flow runs: first, middle and last; ``lightning`` passes them to the
            data.
        optimizer: builds the optimiser from the parameters.
        lr_scheduler: builds the schedule from the optimiser, counted in steps. ReduceLROnPlateau steps after every
            validation instead and monitors ``best`` by default.

    Attributes:
        recipe: configuration of optimiser and schedule, set by ``lightning fit``. Checkpoints store it, as a resumed
            training keeps both.
    """

    #: validation metric of the best checkpoint, and "min" or "max"
    best: ClassVar[tuple[str, str]]
    #: callback that shows clips of every validation in TensorBoard
    pictures: ClassVar[type[Callback]]
    #: callback that prints the table of ``test``; takes the folder of the run
    report: ClassVar[type[Callback]]

    def __init__(
        self,
        network: nn.Module,
        needs: dict[str, Any],
        flow_times: tuple[int, int, int],
        optimizer: OptimizerCallable,
        lr_scheduler: LRSchedulerCallable,
    ) -> None:
        super().__init__()
        self.network = network
        self.needs, self.flow_times = needs, flow_times
        self.make_optimizer = optimizer
        self.make_lr_scheduler = lr_scheduler
        self.recipe: dict[str, Any] = {}

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: str | Path, **arguments: Any) -> Self:
        """Build a module from arguments and load the weights of a checkpoint.

        Args:
            checkpoint_path: checkpoint of ``lightning fit``.
            arguments: constructor arguments; unlike Lightning's method, none are read from the file. Default for
                ``network``: that of the checkpoint, if it is a network of this package.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is damaged or no checkpoint.
        """
        checkpoint = read_checkpoint(checkpoint_path)
        if "network" not in arguments:
            arguments["network"] = read_network(checkpoint_path)
        module = cls(**arguments)
        module.on_load_checkpoint(checkpoint)
        module.load_state_dict(checkpoint["state_dict"])
        return module

    def configure_optimizers(self) -> dict[str, Any]:  # noqa: D102
        return self.optimizers_of(self.network.parameters())

    def optimizers_of(self, parameters: Iterable[nn.Parameter]) -> dict[str, Any]:
        """Return optimiser and schedule for parameters, in the form that Lightning takes."""
        optimizer = self.make_optimizer(parameters)
        schedule = self.make_lr_scheduler(optimizer)
        how = {"scheduler": schedule, "interval": "step"}
        if isinstance(schedule, torch.optim.lr_scheduler.ReduceLROnPlateau):
            every = self._trainer.check_val_every_n_epoch if self._trainer else None
            how |= {"interval": "epoch", "frequency": every or 1}
            how["monitor"] = getattr(schedule, "monitor", self.best[0])
        return {"optimizer": optimizer, "lr_scheduler": how}

    def on_train_batch_start(self, batch: Any, batch_index: int) -> None:
        """Log the true step; Lightning's own count may be off by one after a resume."""
        self.trainer.fit_loop.epoch_loop._batches_that_stepped = self.trainer.global_step

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:  # noqa: D102
        checkpoint["network"] = settings_of(self.network)
        checkpoint["motion"] = motion_of(self.network)
        checkpoint["recipe"] = self.recipe

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:  # noqa: D102
        check_settings(self.network, checkpoint.get("network", {}), "the checkpoint")


def check_resume(checkpoint: Mapping[str, Any], path: str | Path, module: BaseTask) -> None:
    """Check a checkpoint by one step with a temporary optimiser and schedule."""
    weights = [nn.Parameter(weight.detach().clone()) for weight in module.network.parameters()]
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
