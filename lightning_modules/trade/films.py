"""Cost and quality of settings on films, whose pictures are computed one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from pytorch_lightning import LightningDataModule
from torch import Tensor

from lightning_modules.cli.errors import UsageError
from lightning_modules.data import FilmScenes, StillScenes
from lightning_modules.data.sequences import SequenceClips
from lightning_modules.metrics.flicker import film_flicker
from lightning_modules.trade.measure import Measurement, Timed, measure, running, score_pictures
from lightning_modules.trade.runner import Runner
from spikekit import Scene
from spikekit.scenes.frame_sequence import SequenceClip

#: pictures of a film; the first and the last, which lack a neighbour, are not scored
PICTURES = 5

_COUNTED = slice(1, PICTURES - 1)


class FilmRunner:
    """A setting that makes films with a picture every ``every`` clocks.

    ``latency`` is the largest number of later clocks that a picture of the last film waited for.
    """

    def __init__(self, runner: Runner, every: int) -> None:
        self.runner, self.every = runner, every
        self.network, self.device = runner.network, runner.device
        self.latency = 0

    def __call__(self, spikes: Tensor) -> Tensor:
        """Return the pictures of a film, (PICTURES, 3, s H, s W), in [0, 1].

        If the spikes (1, T, H, W) are longer than needed, the middle ones are used.
        """
        length = film_length(self.network.frames, self.every)
        first = (spikes.shape[1] - length) // 2
        came = 0

        def clocks() -> Iterator[Tensor]:
            nonlocal came
            for clock in range(first, first + length):
                came = clock - first
                yield spikes[0, clock : clock + 1]

        pictures, self.latency = [], 0
        for picture in self.runner.film(clocks(), self.every):
            pictures.append(picture.rgb)
            self.latency = max(self.latency, came - picture.clock)
        return torch.stack(pictures)


def film_length(frames: int, every: int) -> int:
    """Return the length of a film in clocks."""
    return frames + (PICTURES - 1) * every


def film_scenes(data: LightningDataModule, frames: int, every: int) -> Iterator[dict[str, Tensor]]:
    """Yield the test scenes of data as films, with the motion of the clips.

    A film has ``spikes`` (1, T, H, W), the three scored pictures ``rgb`` (3, 3, s H, s W), and the ``flow`` from the
    middle picture to the previous and the next one, (2, 2, s H, s W), in pixels of the pictures.
    """
    length = film_length(frames, every)
    if isinstance(data, StillScenes):
        stills = replace(data.val_set, key_frames=PICTURES, every=every)
        for n in range(len(stills)):
            yield _film_scene(stills.whole(n)["spikes"], stills.scene(n), every, stills.scale)
    elif isinstance(data, FilmScenes) and all(source.truth is None for source in data.found.test):
        recipe = replace(data.test_set.recipe, frames=length, key_frames=1, flow_times=())
        if every % recipe.clocks:
            raise UsageError(
                f"--film: expected a multiple of the {recipe.clocks} clocks of a source frame, got {every}"
            )
        clips = SequenceClips(data.found.test, recipe, data.clips or data.found.clips, cache=data.test_set.cache)
        for n in range(len(clips)):
            yield _film_scene(clips[n]["spikes"], recipe.view(*clips.place(n)), every, recipe.scale)
    else:
        raise UsageError(f"--film: expected still pictures in motion or films at full size, got {type(data).__name__}")


def _film_scene(spikes: Tensor, view: Scene | SequenceClip, every: int, scale: int) -> dict[str, Tensor]:
    before, after = view.middle - every, view.middle + every
    rgb = torch.stack([view.rgb(clock) for clock in (before, view.middle, after)])
    flow = torch.stack([view.flow(clock, scale=scale) for clock in (before, after)])
    flow = scale * F.interpolate(flow, rgb.shape[-2:], mode="bilinear", align_corners=False)
    return {"spikes": spikes[None], "rgb": rgb, "flow": flow}


def measure_films(
    rows: Sequence[Measurement], data: LightningDataModule, frames: int, every: int, rounds: int
) -> Timed:
    """Measure settings on films, as :func:`lightning_modules.trade.measure.measure` does on clips."""
    for row in running(rows):
        row.runner = FilmRunner(row.runner, every)
    timed = measure(rows, film_scenes(data, frames, every), rounds, _score)
    for row in running(rows):
        row.seconds = [seconds / PICTURES for seconds in row.seconds]
        row.macs /= PICTURES
    return replace(timed, every=every)


def _score(row: Measurement, film: dict[str, Tensor]) -> None:
    rgb = row.runner(film["spikes"].to(row.runner.device))[_COUNTED]
    truth, middle, ends = film["rgb"].to(rgb), slice(1, 2), slice(0, 3, 2)
    score_pictures(row, rgb, truth)
    pair = rgb[middle].expand(2, -1, -1, -1), rgb[ends], truth[middle].expand(2, -1, -1, -1), truth[ends]
    row.flicker.extend(film_flicker(*pair, film["flow"].to(rgb)).tolist())
    row.latency = row.runner.latency
