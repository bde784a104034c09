"""What all LightningModules of this house share: optimizer, schedule, and checkpoints that know what they are of."""

from __future__ import annotations

from inspect import signature
from typing import Any, ClassVar

from pytorch_lightning import Callback, LightningModule
from pytorch_lightning.cli import LRSchedulerCallable, OptimizerCallable
from torch import nn


class CheckpointMismatchError(ValueError):
    """A checkpoint of another network than the one of this run."""


class Learner(LightningModule):
    """Base of the LightningModules.

    Args:
        network: what learns; its ``settings`` say, as plain values, what it was built with.
        needs: options of the data, by name, that must be as they are here.
        optimizer: builds the optimizer from the parameters.
        lr_scheduler: builds the schedule from the optimizer, counted in steps.
    """

    #: the figure of validation that says which checkpoint is the best, and whether it is the "min" or the "max"
    best: ClassVar[tuple[str, str]]
    #: shows clips of every validation in TensorBoard
    pictures: ClassVar[type[Callback]]
    #: prints the table of ``test``; made with the folder of the run
    report: ClassVar[type[Callback]]

    def __init__(
        self, network: nn.Module, needs: dict[str, Any], optimizer: OptimizerCallable, lr_scheduler: LRSchedulerCallable
    ) -> None:
        super().__init__()
        self.network = network
        self.needs = needs
        self.make_optimizer = optimizer
        self.make_lr_scheduler = lr_scheduler

    def configure_optimizers(self) -> Any:  # noqa: D102
        optimizer = self.make_optimizer(self.network.parameters())
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": self.make_lr_scheduler(optimizer), "interval": "step"},
        }

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:  # noqa: D102
        checkpoint["network"] = {"class": type(self.network).__name__, **self.network.settings}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse weights of another network: scale, say, is in no parameter, and would go unnoticed."""
        here = {"class": type(self.network).__name__, **self.network.settings}
        # an argument that is younger than the checkpoint had the effect of its default
        defaults = {name: parameter.default for name, parameter in signature(type(self.network)).parameters.items()}
        there = {**defaults, **checkpoint.get("network", here)}
        differing = [key for key in here if here[key] != there.get(key)]
        if differing:
            trained = ", ".join(f"{key}={there.get(key)}" for key in differing)
            asked = ", ".join(f"{key}={here[key]}" for key in differing)
            raise CheckpointMismatchError(f"the checkpoint was trained with {trained}; this run asks for {asked}")
