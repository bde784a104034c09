"""Data loaders for clips, which workers make anew in every epoch, and cuts of clips."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np
import torch
from pytorch_lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler

T = TypeVar("T")

_MOST_WORKERS = 16
_A_MOMENT = 2.0  # seconds
_GRACE = 10.0  # seconds


class FreshClips(DistributedSampler[int]):
    """Consecutive indices that continue at the current training step, so a resumed run sees the same clips.

    With several processes, each takes its own batch of every step, so every clip is seen once: a step of two processes
    equals a step of one with twice the batch size.
    """

    def __init__(self, data: LightningDataModule, batch_size: int, length: int) -> None:
        super().__init__(range(length), 1, 0, shuffle=False)  # Lightning would split other samplers itself
        self.data, self.batch_size = data, batch_size
        _, processes = process(data)
        a_batch = batch_size * processes
        if length < a_batch:
            raise ValueError(f"batch_size: {batch_size} x {processes} processes need {a_batch} clips, got {length}")
        self.length = length // a_batch * batch_size

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[int]:
        rank, processes = process(self.data)
        trainer = self.data.trainer
        steps = 0 if trainer is None else trainer.global_step * trainer.accumulate_grad_batches
        for batch in range(self.length // self.batch_size):
            start = ((steps + batch) * processes + rank) * self.batch_size
            yield from range(start, start + self.batch_size)


def process(data: LightningDataModule) -> tuple[int, int]:
    """Return the rank of this process and the number of processes."""
    trainer = data.trainer
    return (0, 1) if trainer is None else (trainer.global_rank, trainer.world_size)


class ClipScenes(LightningDataModule):
    """Data module for clips that are made during training; ``setup`` sets ``train_set``, ``val_set``, ``test_set``."""

    train_clips: int

    def __init__(self, batch_size: int, val_batch_size: int, workers: int | None) -> None:
        super().__init__()
        self.batch_size, self.val_batch_size = batch_size, val_batch_size
        self.workers = default_workers() if workers is None else workers

    def train_dataloader(self) -> DataLoader:  # noqa: D102
        clips = FreshClips(self, self.batch_size, self.train_clips)
        return load_clips(self.train_set, self.batch_size, self.workers, sampler=clips, drop_last=True)

    def val_dataloader(self) -> DataLoader:  # noqa: D102
        return load_clips(self.val_set, self.val_batch_size, self.workers)

    def test_dataloader(self) -> DataLoader:  # noqa: D102
        return load_clips(self.test_set, self.val_batch_size, self.workers)


def cut_key_frames(clip: dict[str, Tensor], key_frames: int, frames: int, every: int) -> dict[str, Tensor]:
    """Cut the spikes of several key frames, (*, T, H, W), into clips ``every`` clocks apart, (*, K, N, H, W)."""
    if key_frames == 1:
        return clip
    spikes = clip["spikes"].unfold(-3, frames, every).movedim(-1, -3).contiguous()
    return {**clip, "spikes": spikes, "every": torch.tensor(every)}


def flow_margin(patch: int, flow_patch: int) -> int:
    """Return the even margin around a patch that lets motion be estimated on at least ``flow_patch`` pixels.

    Example:
        >>> flow_margin(24, 48), flow_margin(26, 48), flow_margin(96, 48)
        (12, 12, 0)
    """
    return 2 * max(0, -((patch - flow_patch) // 4))


def trim(planes: Tensor, margin: int) -> Tensor:
    """Crop a margin: (*, H, W) to (*, H - 2 margin, W - 2 margin)."""
    height, width = planes.shape[-2:]
    return planes[..., margin : height - margin, margin : width - margin]


def load_clips(clips: Dataset, batch_size: int, workers: int, **options: object) -> DataLoader:
    """Return a loader of clips, which are dictionaries of tensors."""
    workers = min(workers, math.ceil(len(clips) / batch_size))
    return _ClipLoader(
        clips,
        batch_size=batch_size,
        num_workers=workers,
        persistent_workers=workers > 0,
        worker_init_fn=start_worker,
        collate_fn=_to_arrays,
        **options,
    )


class Resumable:
    """Mark a loader as resumable for Lightning; its position follows from the training step."""

    def state_dict(self) -> dict[str, object]:  # noqa: D102
        return {}

    def load_state_dict(self, state: dict[str, object]) -> None:  # noqa: D102
        pass


class _ClipLoader(Resumable, DataLoader):
    """A loader whose workers send arrays through pipes, as tensors need more shared memory than containers have."""

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        batches = made_on_cpu(super().__iter__)
        return ({name: torch.from_numpy(value) for name, value in batch.items()} for batch in batches)


def made_on_cpu(batches: Callable[[], Iterator[T]]) -> Iterator[T]:
    """Iterate over a loader with the CPU as the default device."""
    with torch.device("cpu"):
        iterator = batches()
    while True:
        with torch.device("cpu"):
            batch = next(iterator, None)
        if batch is None:
            return
        yield batch


def default_workers() -> int:
    """Return the default number of workers: all cores but one, at most sixteen."""
    # Thirteen were too few for an H100; each needs half a GB. With one core, clips are made between the steps, as a
    # worker would compete with training.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(0, min(_MOST_WORKERS, cores - 1))


def _to_arrays(clips: list[dict[str, Tensor]]) -> dict[str, np.ndarray]:
    return {name: np.stack([clip[name].numpy() for clip in clips]) for name in clips[0]}


def start_worker(_: int) -> None:
    """Prepare a worker process."""
    # schedulers and terminals signal all processes, but training needs its workers to finish its step and save
    signal.signal(signal.SIGINT, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL))  # the loader's, at its end
    signal.signal(signal.SIGTERM, lambda *_: threading.Timer(_GRACE, os._exit, (0,)).start())
    end_when_orphaned()  # torch's own watchdog does not reach workers that wait for a full pipe


def end_when_orphaned() -> None:
    """End this process soon after its parent, even if the parent is killed."""
    parent = os.getppid()

    def wait() -> None:
        while os.getppid() == parent:
            time.sleep(_A_MOMENT)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
