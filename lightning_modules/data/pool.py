"""Pools of scenes that are rendered in bulk on the training device and reused, so that training does not wait."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
import torch
from pytorch_lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from lightning_modules.data.loading import Resumable, made_on_cpu, process, start_worker, trim
from lightning_modules.data.rendering import Gallery

_AT_ONCE = 128  # scenes rendered together
_SYMMETRIC = "RGGB", "BGGR", "grey"  # phases that transposition keeps


class _Drawn(Dataset):
    """Random numbers of many scenes of one kind."""

    def __init__(self, kinds: Sequence[Any]) -> None:
        self.kinds = kinds

    def __getitem__(self, wanted: tuple[int, int, int]) -> dict[str, np.ndarray]:
        kind, first, count = wanted
        drawn = [self.kinds[kind].draw((kind << 40) + index) for index in range(first, first + count)]
        return {name: np.stack([one[name] for one in drawn]) for name in drawn[0]}


class ScenePool(Resumable):
    """Training batches of :class:`StillClips` that are rendered on the training device, in pools.

    Every kind of scene has a pool of ``reuse`` parts with ``size`` clips each. After one random pass over the pool, a
    new part replaces the oldest, so a clip is used ``reuse`` times at long intervals. Half of the batches are reversed
    in time, and half are transposed if the Bayer phase allows it. Batch n depends only on n and the seed.

    If the network has a fixed motion estimator, motion is estimated once for a whole part. Step, device and estimator
    are those of the trainer and the model of ``data``. Every kind has a fraction of the batches, see ``shares``; every
    key frame of a film counts as a clip; ``workers`` processes draw the random numbers of scenes.
    """

    def __init__(
        self,
        data: LightningDataModule,
        kinds: Sequence[Any],
        shares: list[float],
        *,
        size: int,
        reuse: int,
        batch_size: int,
        length: int,
        workers: int,
    ) -> None:
        self.data, self.kinds, self.shares = data, kinds, [share / sum(shares) for share in shares]
        self.reuse, self.length, self.workers = reuse, length, workers
        self.batches = [max(1, batch_size // kind.key_frames) for kind in kinds]
        self.parts = [max(size // kind.key_frames, batch) for kind, batch in zip(kinds, self.batches, strict=True)]
        #: batches of a kind until the oldest part is replaced
        self.rounds = [part * reuse // batch for part, batch in zip(self.parts, self.batches, strict=True)]
        self._next, self._stream = -1, iter(())
        self._gallery: Gallery | None = None

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        trainer = self.data.trainer
        at = 0 if trainer is None else trainer.global_step * trainer.accumulate_grad_batches
        if at != self._next:
            self._stream = self._batches(at)
        self._next = at
        for batch in islice(self._stream, self.length):
            self._next += 1
            yield batch

    def _turns(self, first: int) -> Iterator[tuple[int, int]]:
        """Yield the kind of every batch from ``first`` on and the number of earlier batches of it, evenly mixed."""
        done = [0] * len(self.kinds)
        n = 0
        while True:
            kind = max(range(len(done)), key=lambda k: self.shares[k] * (n + 1) - done[k])
            if n >= first:
                yield kind, done[kind]
            done[kind] += 1
            n += 1

    def _events(self, first: int) -> Iterator[tuple[int, int, int | None]]:
        """Yield parts to render, (kind, number, None), and batches, (kind, round, batch of the round), in order."""
        made = [-1] * len(self.kinds)
        for kind, before in self._turns(first):
            turn, batch = divmod(before, self.rounds[kind])
            for part in range(max(turn, made[kind] + 1), turn + self.reuse):
                yield kind, part, None
                made[kind] = part
            yield kind, turn, batch

    def _wanted(self, first: int) -> Iterator[tuple[int, int, int]]:
        rank, processes = process(self.data)
        for kind, part, batch in self._events(first):
            if batch is None:
                count = self.parts[kind]
                yield kind, (part * processes + rank) * count, count

    def _batches(self, first: int) -> Iterator[dict[str, Tensor]]:
        device = torch.device("cpu") if self.data.trainer is None else self.data.trainer.strategy.root_device
        if self._gallery is None or self._gallery.shades.device != device:
            self._gallery = self.kinds[0].sources.gallery(device)
            for kind in self.kinds:
                kind.sources = self.kinds[0].sources
        loader = DataLoader(
            _Drawn(self.kinds),
            batch_size=None,
            sampler=self._wanted(first),
            num_workers=self.workers,
            worker_init_fn=start_worker,
            collate_fn=dict,  # as it is
        )
        drawn, pools = made_on_cpu(loader.__iter__), [{} for _ in self.kinds]
        for kind, turn, batch in self._events(first):
            pool, count = pools[kind], self.parts[kind]
            if batch is None:
                for name, part in self._made(kind, next(drawn)).items():
                    if name not in pool:
                        pool[name] = part.new_empty(self.reuse * count, *part.shape[1:])
                    start = turn % self.reuse * count
                    pool[name][start : start + count] = part
                continue
            rng = np.random.default_rng([self.kinds[kind].seed, kind, turn])
            order = rng.permutation(self.reuse * count)
            size = self.batches[kind]
            chosen = torch.from_numpy(order[batch * size : (batch + 1) * size]).to(device)
            rng = np.random.default_rng([self.kinds[kind].seed, kind, turn, batch])
            yield self._turned(kind, {name: part[chosen] for name, part in pool.items()}, rng.uniform(size=2) < 0.5)

    @torch.no_grad()
    def _made(self, kind: int, drawn: dict[str, np.ndarray]) -> dict[str, Tensor]:
        """Render clips from drawn numbers and estimate their motion; pictures and flow in half precision."""
        clips, count = self.kinds[kind], self.parts[kind]
        parts: dict[str, list[Tensor]] = {}
        for start in range(0, count, _AT_ONCE):
            some = {name: part[start : start + _AT_ONCE] for name, part in drawn.items()}
            for name, part in clips.render(some, self._gallery).items():
                parts.setdefault(name, []).append(part.half() if name in ("rgb", "flow") else part)
        made = {name: torch.cat(part) for name, part in parts.items()}
        if estimate := _estimator(self.data):
            spikes = clips.cut(made)["spikes"]
            flow = estimate(spikes.flatten(0, -4)).unflatten(0, spikes.shape[:-3])
            made["motion"] = trim(flow, clips.margin).half()
            made["spikes"] = trim(made["spikes"], clips.margin).contiguous()
        return made

    def _turned(self, kind: int, batch: dict[str, Tensor], turns: np.ndarray) -> dict[str, Tensor]:
        clips, film = self.kinds[kind], self.kinds[kind].key_frames > 1
        backwards = turns[0] and sum(clips.flow_times) == clips.frames - 1
        batch = clips.cut(batch)
        for name, part in batch.items():
            if name in ("alpha", "noise", "every"):
                continue
            if backwards:
                keys, times = ([1] if film else []), {"spikes": [-3], "flow": [-4], "motion": [-4]}.get(name, [])
                part = part.flip([*keys, *times])
            if turns[1] and clips.pattern in _SYMMETRIC:
                part = part.mT
                part = part.flip(-3) if name in ("flow", "motion") else part
            batch[name] = part if name == "spikes" else part.float()
        return batch | {"every": batch["every"].expand(len(batch["rgb"]))} if film else batch


def _estimator(data: LightningDataModule) -> Any:
    """Return the motion estimator of the training if it is used and fixed, else ``None``."""
    model = None if data.trainer is None else data.trainer.lightning_module
    network = getattr(model, "network", None)
    if getattr(model, "flow", None) != "estimated" or not network.takes_flow or network.motion.static:
        return None
    learns = any(parameter.requires_grad for parameter in network.motion.parameters())
    return None if learns else network.estimate_flow
