"""Checkpoints of ``lightning fit`` as Lightning reads, writes and removes them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from lightning_fabric.plugins import TorchCheckpointIO
from pytorch_lightning import LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.utilities.exceptions import SIGTERMException

from lightning_modules.storage.checkpoint import DivergedError, check_tensors, read_checkpoint
from spikekit.io.whole_file import whole_file

#: weights that forked or spawned processes of Lightning hand on to the one that started them
_HANDED_ON = ".temp.ckpt"


class LastCheckpoint(ModelCheckpoint):
    """Also saves where SIGTERM ends a training: Lightning then ends it between two steps."""

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:  # noqa: D102
        self.save_on_exception = isinstance(exception, SIGTERMException)
        super().on_exception(trainer, pl_module, exception)


def requeued_checkpoint(output: str | Path) -> str | None:
    """Return the newest checkpoint that a SLURM job which was requeued has left in its folder, None for other runs."""
    output = Path(output)
    saved = [*output.glob("hpc_ckpt_*.ckpt")]  # Lightning writes them before it asks for the job to be queued again
    if "SLURM_JOB_ID" not in os.environ or not (saved or int(os.environ.get("SLURM_RESTART_COUNT") or 0)):
        return None
    found = [path for path in (*saved, output / "checkpoints" / "last.ckpt") if path.is_file()]
    return str(max(found, key=lambda path: path.stat().st_mtime_ns)) if found else None


class Checkpoints(TorchCheckpointIO):
    """How Lightning reads, writes and removes checkpoints: without running code, whole, and nothing else than them."""

    def __init__(self, folder: str | Path) -> None:
        super().__init__()
        self._folder, self._saved = Path(os.path.abspath(folder)), set()

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint; one that was there stays until the new one is complete.

        Raises:
            DivergedError: its weights are not finite; the checkpoint that was there is what training can go on from.
        """
        try:
            # processes that Lightning forks or spawns hand on the weights alone
            check_tensors(checkpoint.get("state_dict", checkpoint))
        except ValueError as error:
            raise DivergedError(f"{path}: not written, as the training has diverged ({error})") from error
        with whole_file(path) as file:
            try:
                torch.save(checkpoint, file)
            except RuntimeError as error:  # torch's own writer, when the disk is full
                if isinstance(error.__context__, OSError):
                    raise error.__context__ from None
                raise
        self._saved.add(Path(os.path.abspath(path)))

    def load_checkpoint(self, path: str | Path, *_: Any, **__: Any) -> dict[str, Any]:
        """Read a checkpoint."""
        if Path(path).name == _HANDED_ON:
            return torch.load(path, map_location="cpu", weights_only=True)
        return read_checkpoint(path)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove a checkpoint of this run; anything else that a checkpoint may name as one of its own stays."""
        path = Path(os.path.abspath(path))
        if path.suffix == ".ckpt" and path.is_file() and (path in self._saved or self._folder in path.parents):
            path.unlink()
