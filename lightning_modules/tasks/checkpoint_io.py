"""Reading, writing and removal of the checkpoints of ``lightning fit``."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import torch
from lightning_fabric.plugins import TorchCheckpointIO
from pytorch_lightning import LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.utilities.exceptions import SIGTERMException

from lightning_modules.storage.checkpoint import DivergedError, check_tensors, read_checkpoint
from spikekit.io.whole_file import whole_file

#: file by which forked or spawned processes of Lightning pass weights to their parent
_HANDED_ON = ".temp.ckpt"


class LastCheckpoint(ModelCheckpoint):
    """Checkpoint that is also saved on SIGTERM and Ctrl-C, after which Lightning ends the training between two steps.

    A second Ctrl-C ends it at once. With several processes, and where Lightning does not handle SIGTERM, so does the
    first.
    """

    interrupted = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:  # noqa: D102
        super().on_train_start(trainer, pl_module)

        def interrupt(*_: object) -> None:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            self.interrupted = True
            print("\nCtrl-C: a checkpoint is saved after this step; a second Ctrl-C stops at once")  # noqa: T201
            signal.raise_signal(signal.SIGTERM)

        if trainer.world_size == 1 and signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
            signal.signal(signal.SIGINT, interrupt)  # until Lightning restores all handlers

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:  # noqa: D102
        if trainer.progress_bar_callback is not None:
            print()  # noqa: T201 - ends the line of the progress bar
        self.save_on_exception = isinstance(exception, SIGTERMException)
        super().on_exception(trainer, pl_module, exception)


def requeued_checkpoint(output: str | Path) -> str | None:
    """Return the newest checkpoint of a requeued SLURM job; ``None`` for other runs."""
    output = Path(output)
    saved = [*output.glob("hpc_ckpt_*.ckpt")]  # written by Lightning before it requeues the job
    if "SLURM_JOB_ID" not in os.environ or not (saved or int(os.environ.get("SLURM_RESTART_COUNT") or 0)):
        return None
    found = [path for path in (*saved, output / "checkpoints" / "last.ckpt") if path.is_file()]
    return str(max(found, key=lambda path: path.stat().st_mtime_ns)) if found else None


class Checkpoints(TorchCheckpointIO):
    """Checkpoint I/O for Lightning: reads without running code, writes atomically, removes only own checkpoints."""

    def __init__(self, folder: str | Path) -> None:
        super().__init__()
        self._folder, self._saved = Path(os.path.abspath(folder)), set()

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint atomically, if its weights are finite; training can resume from the previous one."""
        try:
            # files of forked or spawned processes are plain weights
            check_tensors(checkpoint.get("state_dict", checkpoint))
        except ValueError as error:
            raise DivergedError(f"{path}: not written, as the training has diverged ({error})") from error
        with whole_file(path) as file:
            try:
                torch.save(checkpoint, file)
            except RuntimeError as error:  # from torch's writer if the disk is full
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
        """Remove a checkpoint of this run; other files, which a checkpoint may name as well, are kept."""
        path = Path(os.path.abspath(path))
        if path.suffix == ".ckpt" and path.is_file() and (path in self._saved or self._folder in path.parents):
            path.unlink()
