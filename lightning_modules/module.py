"""The LightningModule that trains and judges super-resolution networks."""

from __future__ import annotations

from inspect import signature
from typing import Any

import torch
import torch.nn.functional as F
from pytorch_lightning import LightningModule
from pytorch_lightning.cli import LRSchedulerCallable, OptimizerCallable
from torch import Tensor

from lightning_modules.networks import ClassicalDecoder, Network
from lightning_modules.tiles import forward_in_tiles
from spikekit import psnr, ssim


class CheckpointMismatchError(ValueError):
    """A checkpoint of another network than the one of this run."""


class SuperResolution(LightningModule):
    """Train a network on clips whose truth is known, judge it beside the classical decoders, run it on recordings.

    Training uses the flow of the scene, where the data have it: the true one of analytic scenes, or that which the
    frames of a film were interpolated with. Everything else uses the network's own estimator, as a recording would;
    ``test`` shows the result with the scene's flow in a row of its own.

    Args:
        network: the network, such as CSCSR.
        optimizer: builds the optimizer from the parameters; the paper uses Adam at 1e-4.
        lr_scheduler: builds the schedule from the optimizer, counted in steps; the paper multiplies by 0.8 every 7500.
        tile: side of the tiles, in sensor pixels, in which ``predict`` works through a large recording; 0 for none.
    """

    def __init__(
        self,
        network: Network,
        optimizer: OptimizerCallable = lambda parameters: torch.optim.Adam(parameters, lr=1e-4),
        lr_scheduler: LRSchedulerCallable = lambda optimizer: torch.optim.lr_scheduler.StepLR(optimizer, 7500, 0.8),
        tile: int = 128,
    ) -> None:
        super().__init__()
        if tile < 0 or tile % 2:
            raise ValueError(f"tile: expected an even number of sensor pixels, or 0 for no tiles, got {tile}")
        self.network = network
        self.make_optimizer = optimizer
        self.make_lr_scheduler = lr_scheduler
        self.tile = tile

    def configure_optimizers(self) -> Any:  # noqa: D102
        optimizer = self.make_optimizer(self.network.parameters())
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": self.make_lr_scheduler(optimizer), "interval": "step"},
        }

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:  # noqa: D102
        rgb = self.network(batch["spikes"], batch.get("flow"))
        loss = F.l1_loss(rgb, batch["rgb"])
        self.log("train/loss", loss)
        self.log("train/psnr", psnr(rgb.detach(), batch["rgb"]).mean(), prog_bar=True)
        return loss

    def validation_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:  # noqa: D102
        rgb = self.network(batch["spikes"])
        count = len(rgb)
        self.log("val/psnr", psnr(rgb, batch["rgb"]).mean(), prog_bar=True, batch_size=count, sync_dist=True)
        self.log("val/ssim", ssim(rgb, batch["rgb"]).mean(), batch_size=count, sync_dist=True)
        return rgb.clamp(0, 1)

    def test_step(self, batch: dict[str, Tensor], batch_index: int) -> dict[str, Tensor]:
        """Return the picture of every method, by name."""
        spikes, settings = batch["spikes"], self.network.settings
        name = type(self.network).__name__
        shared = settings["scale"], settings["pattern"], settings["alpha"]
        pictures = {
            "TFI": ClassicalDecoder("tfi", *shared)(spikes),
            "TFP": ClassicalDecoder("tfp", *shared)(spikes),
            name: self.network(spikes),
        }
        if "flow" in batch:
            pictures[f"{name}, true flow"] = self.network(spikes, batch["flow"])
        return pictures

    def predict_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:
        """Return rgb (B, 3, s H, s W), clamped to [0, 1]."""
        return forward_in_tiles(self.network, batch["spikes"], self.tile).clamp(0, 1)

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
