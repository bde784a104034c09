"""Base class of the LightningModules: optimizer, schedule, checkpoints that know their network."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from pytorch_lightning import Callback, LightningModule
from pytorch_lightning.cli import LRSchedulerCallable, OptimizerCallable
from torch import nn

from lightning_modules.networks.network import read_network
from lightning_modules.storage.checkpoint import read_checkpoint
from lightning_modules.storage.pretrained import check_settings, motion_of, settings_of


def step_schedule(optimizer: torch.optim.Optimizer) -> torch.optim.lr_scheduler.StepLR:
    """Times 0.8 every 7500 steps, as in the paper."""
    return torch.optim.lr_scheduler.StepLR(optimizer, 7500, 0.8)


class BaseTask(LightningModule):
    """Base of the LightningModules.

    Args:
        network: what learns; its ``settings`` say, as plain values, what it was built with.
        needs: options of the data, by name, that must be as they are here.
        flow_times: frames that flow runs between, the first, the middle and the last; ``lightning`` tells the data.
        optimizer: builds the optimizer from the parameters.
        lr_scheduler: builds the schedule from the optimizer, counted in steps; ReduceLROnPlateau is asked after every
            validation instead, and watches what ``best`` names unless it has a ``monitor`` of its own.

    Attributes:
        recipe: what a configuration says of optimizer and schedule, which ``lightning fit`` fills in; a checkpoint
            remembers it, because it resumes with its own.
    """

    #: the figure of validation that says which checkpoint is the best, and whether it is the "min" or the "max"
    best: ClassVar[tuple[str, str]]
    #: shows clips of every validation in TensorBoard
    pictures: ClassVar[type[Callback]]
    #: prints the table of ``test``; made with the folder of the run
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
        """Build a module from arguments and give it the weights of a checkpoint, and its network, if none is given.

        Args:
            checkpoint_path: a checkpoint of ``lightning fit``.
            arguments: those of the constructor; Lightning would take them out of the file, and build what it names.
                Without a ``network`` it is that of the checkpoint, which is then one of this package.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file is damaged or of something else.
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
        """Return the optimizer and the schedule of parameters, as Lightning takes them."""
        optimizer = self.make_optimizer(parameters)
        schedule = self.make_lr_scheduler(optimizer)
        how = {"scheduler": schedule, "interval": "step"}
        if isinstance(schedule, torch.optim.lr_scheduler.ReduceLROnPlateau):
            every = self._trainer.check_val_every_n_epoch if self._trainer else None
            how |= {"interval": "epoch", "frequency": every or 1}
            how["monitor"] = getattr(schedule, "monitor", self.best[0])
        return {"optimizer": optimizer, "lr_scheduler": how}

    def on_train_batch_start(self, batch: Any, batch_index: int) -> None:
        """Let loggers have the step that training stands at; resumed, Lightning's own count may be one off."""
        self.trainer.fit_loop.epoch_loop._batches_that_stepped = self.trainer.global_step

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:  # noqa: D102
        checkpoint["network"] = settings_of(self.network)
        checkpoint["motion"] = motion_of(self.network)
        checkpoint["recipe"] = self.recipe

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:  # noqa: D102
        check_settings(self.network, checkpoint.get("network", {}), "the checkpoint")
