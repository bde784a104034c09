"""A callback for training on a GPU: schedule by time, progress lines, and weights that are written regularly."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from pytorch_lightning.callbacks import Timer, WeightAveraging
from torch import nn

from lightning_modules.storage.pretrained import Weights, motion_of, settings_of, write_weights


class Pace(Callback):
    """Schedule the learning rate by steps or time, print progress, and write weights at intervals.

    The rate rises to that of the optimiser during ``warm_up`` steps, then falls along a cosine to a hundredth at
    ``max_steps`` or ``max_time`` of the trainer, whichever comes first; it overrides any schedule of the configuration.
    The weights are written to ``weights.safetensors`` in the folder of the run, in half precision, averaged if a
    callback of the trainer averages them. On a GPU, the network uses channels-last memory.

    Args:
        warm_up: steps until the full learning rate.
        line_every: seconds between progress lines.
        weights_every: seconds between two writes of the weights; they are also written at the end.
    """

    def __init__(self, warm_up: int = 200, line_every: float = 10.0, weights_every: float = 60.0) -> None:
        self.warm_up, self.line_every, self.weights_every = warm_up, line_every, weights_every

    def on_fit_start(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        if module.device.type == "cuda":
            module.network.to(memory_format=torch.channels_last)

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        self._said = self._written = time.monotonic()
        self._step, self._clips, self._loss = trainer.global_step, 0, None

    def on_train_batch_start(  # noqa: D102
        self, trainer: Trainer, module: LightningModule, batch: Any, batch_index: int
    ) -> None:
        share = min(max(share_done(trainer), 0.0), 1.0)
        factor = (0.505 + 0.495 * math.cos(math.pi * share)) * min(1, (trainer.global_step + 1) / self.warm_up)
        for optimizer in trainer.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"] * factor

    def on_train_batch_end(  # noqa: D102
        self, trainer: Trainer, module: LightningModule, outputs: Any, batch: Any, batch_index: int
    ) -> None:
        loss, now = outputs["loss"].detach(), time.monotonic()
        self._clips += batch["rgb"].shape[:-3].numel() * trainer.world_size
        self._loss = loss if self._loss is None else self._loss.lerp(loss, 0.02)
        if now - self._said >= self.line_every:
            loss = float(self._loss)  # waits for the device, so that only finished steps count
            took = time.monotonic() - self._said
            rate = self._clips / took
            steps = (trainer.global_step - self._step) / took
            if trainer.is_global_zero:
                said = f"step {trainer.global_step}, {share_done(trainer):.0%}: {steps:.2f} steps/s, {rate:.0f} clips/s"
                said += f", loss {loss:.5f}, lr {trainer.optimizers[0].param_groups[0]['lr']:.2g}"
                print(said, flush=True)  # noqa: T201
            self._said, self._step, self._clips = time.monotonic(), trainer.global_step, 0
        if now - self._written >= self.weights_every:
            self._write(trainer, module)
            self._written = time.monotonic()

    def on_train_end(self, trainer: Trainer, module: LightningModule) -> None:  # noqa: D102
        self._write(trainer, module)

    def on_exception(self, trainer: Trainer, module: LightningModule, exception: BaseException) -> None:  # noqa: D102
        if hasattr(self, "_written"):
            self._write(trainer, module)

    def _write(self, trainer: Trainer, module: LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        network = averaged(trainer, module).network
        tensors = {
            name: value.half() if value.is_floating_point() else value
            for name, value in ((name, value.detach().cpu()) for name, value in network.state_dict().items())
        }
        path = Path(trainer.default_root_dir) / "weights.safetensors"
        write_weights(Weights(path, settings_of(network), motion_of(network), tensors), path)


def averaged(trainer: Trainer, module: LightningModule) -> nn.Module:
    """Return the averaged module of a callback, or the module itself."""
    for callback in trainer.callbacks:
        if isinstance(callback, WeightAveraging) and getattr(callback, "_average_model", None) is not None:
            return callback._average_model.module
    return module


def share_done(trainer: Trainer) -> float:
    """Return the finished fraction of the training, by steps or by time."""
    shares = [trainer.global_step / trainer.max_steps] if trainer.max_steps > 0 else []
    for callback in trainer.callbacks:
        if isinstance(callback, Timer) and callback.time_remaining() is not None:
            passed, left = callback.time_elapsed(), callback.time_remaining()
            shares.append(passed / max(passed + left, 1e-9))
    return max(shares, default=0.0)
