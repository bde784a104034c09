"""Measure quality and time of all settings on the same clips, with times taken in turns."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.utils.data import DataLoader
from torch.utils.flop_counter import FlopCounterMode

from lightning_modules.metrics.image import measures
from lightning_modules.trade.runner import Runner
from lightning_modules.trade.settings import Setting
from spikekit.arguments import one_line
from spikekit.progress import progress
from spikekit.timing import Timer, peak_memory, timer_of


@dataclass
class Measurement:
    """A setting and its measurements so far, or the ``reason`` why it cannot run."""

    setting: Setting
    runner: Runner | None = None
    reason: str | None = None
    psnr: list[float] = field(default_factory=list)  # of every clip, in dB
    ssim: list[float] = field(default_factory=list)
    lpips: list[float] = field(default_factory=list)  # empty if not available
    seconds: list[float] = field(default_factory=list)  # of one picture, for every round
    memory: float | None = None  # increase by a clip, in MiB; None if not available
    macs: float | None = None  # of convolutions and matrix products per sensor pixel
    flicker: list[float] = field(default_factory=list)  # of pairs of pictures in films
    latency: int | None = None  # of a film in clocks

    @property
    def parameters(self) -> int:
        """Number of parameters of the network and its motion estimator."""
        return sum(parameter.numel() for parameter in self.runner.network.parameters())


@dataclass(frozen=True)
class Timed:
    """How times were taken: number of clips, their size in sensor pixels, rounds, and the kind of time.

    ``every`` is the number of clocks between two pictures of a film; ``None`` for single clips.
    """

    clips: int
    size: tuple[int, int]
    rounds: int
    unit: str
    every: int | None = None


def measure(
    rows: Sequence[Measurement],
    clips: Iterable[dict[str, Tensor]],
    rounds: int,
    score: Callable[[Measurement, dict[str, Tensor]], None] | None = None,
) -> Timed:
    """Score and time the settings that can run; a setting that fails gets a reason, and the others continue.

    All settings are scored on a clip before the next one is loaded, which also warms them up. Then they are timed on
    the clips that have the size of the first. Memory and work are measured on the first. Times do not include moving
    the spikes to the device.
    """
    kept: list[Tensor] = []
    for clip in progress(clips, "clips scored"):
        if len(kept) < rounds and (not kept or clip["spikes"].shape == kept[0].shape):
            kept.append(clip["spikes"])
        for row in running(rows):
            attempt(row, lambda row=row, clip=clip: (score or _score)(row, clip))
    for row in progress(running(rows), "settings measured"):
        attempt(row, lambda row=row: _weigh(row, kept[0]))
    rows = running(rows)
    time_in_turns(rows, kept, rounds)
    units = dict.fromkeys(_timer(row)[1] for row in rows)
    return Timed(len(kept), tuple(kept[0].shape[-2:]), rounds, ", ".join(units))


def running(rows: Sequence[Measurement]) -> list[Measurement]:
    """Return the rows without a failure so far."""
    return [row for row in rows if row.reason is None]


def time_in_turns(rows: Sequence[Measurement], clips: Sequence[Tensor], rounds: int) -> None:
    """Time all rows once per round, on the same clip; each round begins with another row.

    Other load on the machine and differences between clips then affect all rows alike, and no row is always first.
    """
    firsts = [turn % max(1, len(rows)) for turn in range(rounds)]
    turns = [(turn, row) for turn, first in enumerate(firsts) for row in [*rows[first:], *rows[:first]]]
    for turn, row in progress(turns, "timings"):
        spikes = clips[turn % len(clips)].to(row.runner.device)
        timer, _ = _timer(row)
        row.seconds.append(timer(lambda row=row, spikes=spikes: row.runner(spikes), 1))


def _timer(row: Measurement) -> tuple[Timer, str]:
    return timer_of(row.runner.device, torch.get_num_threads())


def single_clips(scenes: DataLoader) -> Iterator[dict[str, Tensor]]:
    """Yield single clips, as in a recording; the cost of a batch depends on its size."""
    for batch in scenes:
        for n in range(len(batch["spikes"])):
            yield {name: value[n : n + 1] for name, value in batch.items()}


def attempt(row: Measurement, work: Callable[[], None]) -> None:
    """Run a function for a row; if it fails, the row gets the reason."""
    try:
        work()
    except Exception as error:  # the other rows continue
        row.reason = f"{type(error).__name__}: {one_line(error)[:200]}"
        row.runner = None  # frees its memory


def _score(row: Measurement, clip: dict[str, Tensor]) -> None:
    score_pictures(row, row.runner(clip["spikes"].to(row.runner.device)), clip["rgb"])


def score_pictures(row: Measurement, rgb: Tensor, truth: Tensor) -> None:
    """Add the scores of pictures to a row."""
    for measure in measures():
        getattr(row, measure.name).extend(measure.of(rgb, truth.to(rgb.device)).tolist())


def _weigh(row: Measurement, spikes: Tensor) -> None:
    """Measure memory and multiplications for one clip."""
    device = row.runner.device
    spikes = spikes.to(device)
    with FlopCounterMode(display=False) as counter:
        row.runner(spikes)
    row.macs = counter.get_total_flops() / 2 / (spikes.shape[-2] * spikes.shape[-1])
    gc.collect()
    row.memory = peak_memory(lambda: row.runner(spikes), device)
