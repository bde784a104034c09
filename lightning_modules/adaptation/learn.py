"""Train a network on lessons of a recording, and judge it by those that are held out."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pytorch_lightning import Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from lightning_modules.adaptation.lessons import HELD_OUT, Lessons
from lightning_modules.inference.tiles import TILE, forward_in_tiles
from lightning_modules.networks import Network
from lightning_modules.tasks.checkpoint_io import Checkpoints
from lightning_modules.tasks.resume import check_resume, load_weights_of
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import psnr
from spikekit.color.cfa import GREY

#: what is kept of a training that is interrupted
CHECKPOINT = "last.ckpt"

_PATCH, _BATCH, _RATE = 40, 4, 1e-3
_RISING = 10  # steps until the rate is reached; then it falls to 0
_EVERY = 20  # steps from one checkpoint to the next
# of what Lightning would warn
_KNOWN = r".*(no `val_dataloader`|exists and is not empty|not resumable|dirpath has changed)"


class _Patches(Dataset):
    """Patches of lessons, by chance; which, only the index says, counted from ``start``."""

    def __init__(self, lessons: Lessons, pattern: str, scale: int, length: int, start: int = 0) -> None:
        self.lessons, self.scale, self.length, self.start = lessons, scale, length, start
        self.symmetric = pattern in ("RGGB", "BGGR", GREY)  # transposed, it begins with the same colours

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        rng = np.random.default_rng(self.start + index)
        one, s = int(rng.integers(len(self.lessons))), self.scale
        sides = self.lessons.spikes.shape[-2:]
        size = min(*sides, _PATCH)
        y, x = (2 * int(rng.integers((side - size) // 2 + 1)) for side in sides)
        here, there = (tuple(slice(k * z, k * (z + size)) for z in (y, x)) for k in (1, s))
        patch = {"spikes": self.lessons.spikes[one][..., *here], "rgb": self.lessons.rgb[one][..., *there].float()}
        if self.lessons.flow is not None:
            patch["flow"] = self.lessons.flow[one][..., *here]
        if rng.uniform() < 0.5:  # backwards in time
            patch |= {name: patch[name].flip(0) for name in ("spikes", "flow") if name in patch}
        if self.symmetric and rng.uniform() < 0.5:
            patch = {name: value.mT for name, value in patch.items()}
            if "flow" in patch:
                patch["flow"] = patch["flow"].flip(-3)
        return {name: value.contiguous() for name, value in patch.items()}


@torch.no_grad()
def likeness(network: Network, lessons: Lessons) -> float:
    """Return the PSNR in dB of pictures by a network to those of the teacher, as they would be shown."""
    values, device = [], next(network.parameters()).device
    for number in range(len(lessons)):
        one = lessons.part(slice(number, number + 1))
        flow = None if one.flow is None else one.flow.to(device)
        rgb = forward_in_tiles(network, one.spikes.to(device), TILE, flow=flow)
        shown = [(picture.float() / lessons.white).clamp(0, 1) for picture in (rgb, one.rgb.to(device))]
        values.append(psnr(*shown).mean())
    return torch.stack(values).mean().item()


def _rate(step: int, steps: int) -> float:
    return min(1, (step + 1) / _RISING) * (1 - step / (steps + 1))


def learn(student: Network, lessons: Lessons, steps: int, folder: Path, **trainer: Any) -> tuple[float, float]:
    """Train a network on lessons; it goes on where a training in the folder was interrupted.

    Args:
        student: what learns, in evaluation mode.
        lessons: those that are held out last.
        steps: how long.
        folder: of the checkpoint ``last.ckpt``.
        trainer: other arguments of Lightning's Trainer.

    Returns:
        Likeness of the held-out pictures to the teacher's before and after, in dB.
    """
    taught, held_out = lessons.part(slice(-HELD_OUT)), lessons.part(slice(-HELD_OUT, None))
    before = likeness(student, held_out)
    schedule = partial(torch.optim.lr_scheduler.LambdaLR, lr_lambda=partial(_rate, steps=steps))
    module = SuperResolution(student, partial(torch.optim.Adam, lr=_RATE), schedule)
    device = next(student.parameters()).device
    last = ModelCheckpoint(folder, Path(CHECKPOINT).stem, every_n_train_steps=_EVERY, enable_version_counter=False)
    running = Trainer(
        max_steps=steps,
        max_epochs=-1,
        devices=1,
        logger=False,
        callbacks=[last],
        plugins=[Checkpoints()],
        enable_model_summary=False,
        default_root_dir=folder,
        **trainer,
    )
    seen, resumed = 0, None
    if (folder / CHECKPOINT).is_file():
        resumed = folder / CHECKPOINT
        checkpoint = check_resume(resumed, module, running)
        load_weights_of(checkpoint, resumed, module)
        seen = _BATCH * checkpoint["global_step"]
    patches = _Patches(taught, student.pattern, student.scale, _BATCH * steps, seen)
    student.train()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", _KNOWN)
        running.fit(module, DataLoader(patches, _BATCH), ckpt_path=resumed and str(resumed))
    return before, likeness(student.to(device).eval(), held_out)
