"""Recordings in files, cut into clips for ``lightning predict``."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from inspect import signature
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pytorch_lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import Dataset, default_collate

from lightning_modules.data.clips_around import clips_around, film_groups
from lightning_modules.signatures import takes
from spikekit import bayer_sites
from spikekit.arguments import frames_of
from spikekit.io.recording import open_recording, white_rate

# clips that are looked at for what is white, from the first to the last of the recording
_LOOKS = 8


class RecordingClips(Dataset[dict[str, Any]]):
    """Clips around some frames of a recording, read on demand or one after the other.

    Args:
        path: a ``.dat`` or ``.npz`` file, see :func:`spikekit.read_spikes`.
        height: rows; needed for a ``.dat`` without side-car or camera, as it has no header.
        width: columns; likewise.
        flip: turn the stored frames upside down, as real cameras need.
        pattern: Bayer phase after the flip, one of RGGB, BGGR, GRBG, GBRG; that of the side-car or the camera, or else
            RGGB, when not given. "grey" for a camera without colours, whose pictures are grey then.
        frames: spike frames N of a clip, as the network was trained.
        every: frames between two clips, or two reconstructed pictures; 20 is a millisecond at 20 kHz.
        crop_to: Bayer phase that the network was trained with; clips begin with it, a row and a column less at most.
        camera: what recorded it: m1k40, m1k40-bayer, uhsr, vidar, or a .json file of the same form; gives the size, the
            flip, the Bayer phase, what to crop, and the gamma of the pictures.
        frame: which frames are in the middle of clips and reconstructed: N, or from A to B - 1 as A:B or A:B:STEP,
            ``every`` apart where STEP is left out; all when not given.
        white: spikes a frame of a pixel that is shown white; less makes pictures brighter. When not given, that of the
            side-car, or else what 99.9 % of the pixels of the recording do not exceed, the same in all its pictures.
        calibration: what spikekit calibrate measured of the pixels; the spikes are made those of an ideal sensor by it.
            When not given, the recording's own, NAME.calibration.safetensors beside it; "none" for none.

    Attributes:
        size: (H, W) of a clip.
        recording: the file and what is known of it.
        chosen: the frames in the middle of the clips, in order.
        made: those of them whose pictures are there already.
        part: which part of them is wanted, counted from 0, and of how many.
        grey: whether the camera is known to have no colours.

    Raises:
        spikekit.SpikeFileError: the file cannot be read.
        ValueError: the recording is shorter than a clip, less than 3 x 3 pixels are left, or an argument is out of
            range.
    """

    def __init__(
        self,
        path: str,
        height: int | None = None,
        width: int | None = None,
        flip: bool = False,
        pattern: str | None = None,
        frames: int = 41,
        every: int = 20,
        crop_to: str = "RGGB",
        camera: str | None = None,
        frame: str | None = None,
        white: float | None = None,
        calibration: str | None = None,
    ) -> None:
        if every < 1:
            raise ValueError(f"every: expected at least 1 frame, got {every}")
        if white is not None and not 0 < white < float("inf"):
            raise ValueError(f"white: expected a finite number above 0, got {white}")
        self._white = white
        known = {"height": height, "width": width, "flip": flip, "camera": camera, "calibration": calibration}
        said = None if pattern == "grey" else pattern
        self.recording = open_recording(Namespace(file=Path(path), pattern=said, **known))
        total, (rows, columns) = self.recording.frames, self.recording.size
        if total < frames:
            raise ValueError(f"{path}: expected at least {frames} frames for a clip, got {total}")
        phase = self.recording.pattern or "RGGB"
        self.grey = pattern == "grey" or (self.recording.camera is not None and self.recording.pattern is None)
        if self.grey:
            phase = crop_to  # one is as good as another
        # where red is says which of the four phases it is
        (_, row, column), (_, to_row, to_column) = bayer_sites(phase)[0], bayer_sites(crop_to)[0]
        self.top, self.left = (row - to_row) % 2, (column - to_column) % 2
        self.size = rows - self.top, columns - self.left
        if min(self.size) < 3:
            raise ValueError(f"{path}: expected at least 3 x 3 pixels that begin with {crop_to}, got {self.size}")
        self.frames = frames
        self.made: set[int] = set()
        self.part = 0, 1
        self._every_clip = range(frames // 2, total - (frames - 1) // 2, every)
        try:
            ends = self._every_clip[0], total - 1 - (frames - 1) // 2
            self.chosen = list(self._every_clip if frame is None else frames_of(frame, *ends, every))
        except ValueError as error:
            raise ValueError(f"frame: {error}; a clip has {frames} frames of the {total} of {path}") from error

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not 0 <= index < len(self):
            raise IndexError(index)
        middle = self.chosen[index]
        spikes = self.recording.read(middle - self.frames // 2, self.frames)
        return self._item(middle, self._prepared(spikes).contiguous())

    def in_order(self, chosen: Iterable[int]) -> Iterator[dict[str, Any]]:
        """Yield the clips around some frames, increasing ones, and read the recording but once for all of them."""
        return (self._item(middle, spikes) for middle, spikes in self._around(list(chosen)))

    def _item(self, middle: int, spikes: Tensor) -> dict[str, Any]:
        return {"spikes": spikes, "frame": middle, "white": torch.tensor(self.white)}

    @cached_property
    def white(self) -> float:
        """Spikes a frame of a white pixel, which is the same for whichever frames are chosen."""
        known = self._white or self.recording.alpha
        if known is not None:
            return known
        clips = self._every_clip
        looks = sorted({clips[round(n)] for n in np.linspace(0, len(clips) - 1, _LOOKS)})
        return white_rate(torch.stack([clip.float().mean(0) for _, clip in self._around(looks)]).mean(0))

    def _around(self, middles: list[int]) -> Iterator[tuple[int, Tensor]]:
        def jump(start: int) -> Iterator[Tensor]:
            return self.recording.frames_from(start)

        # what is packed is unpacked from its beginning, wherever reading begins
        packed = self.recording.path.suffix.lower() == ".npz"
        start = middles[0] - self.frames // 2 if middles else 0
        clips = clips_around(middles, self.frames, jump(start), start, None if packed else jump)
        return ((middle, self._prepared(clip)) for middle, clip in clips)

    def _prepared(self, spikes: Tensor) -> Tensor:
        return self.recording.correct_spikes(spikes)[..., self.top :, self.left :]


class _Batches:
    """Groups of clips that follow each other; those of one process, where several share a recording, do so as well.

    Groups whose pictures are made already are left out, but for those that a network which carries on what it knows of
    one key frame to the next has to see again: their clips are not ``shown``.
    """

    def __init__(
        self,
        clips: RecordingClips,
        process: int,
        processes: int,
        future: int = 0,
        interpolated: int = 0,
        warm_up: int = 0,
    ) -> None:
        self.clips = clips
        groups = list(film_groups(clips.chosen, future, interpolated))
        part, parts = clips.part
        wanted = range(*(len(groups) * n // parts for n in (part, part + 1)))
        wanted = [n for n in wanted if not clips.made.issuperset(groups[n])]
        mine = {*wanted[slice(*(len(wanted) * n // processes for n in (process, process + 1)))]}
        before = -(-warm_up // ((future + 1) * (interpolated + 1)))
        seen = sorted({n for last in mine for n in range(max(last - before, 0), last + 1)})
        self.groups = [(groups[n], n in mine) for n in seen]

    def __len__(self) -> int:
        return len(self.groups)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        clips = self.clips.in_order(frame for frames, _ in self.groups for frame in frames)
        for frames, mine in self.groups:
            shown = [mine and frame not in self.clips.made for frame in frames]
            yield {**default_collate(list(islice(clips, len(frames)))), "shown": torch.tensor(shown)}


class Recording(LightningDataModule):
    """One recording of a colour spike camera, for ``predict``.

    Size, Bayer phase and gain can be omitted if a side-car beside the recording, or ``camera``, specifies them.

    Its arguments are those of :class:`RecordingClips`.
    """

    @takes(RecordingClips)
    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__()
        self.allow_zero_length_dataloader_with_multiple_devices = True  # of more processes than pictures are left
        self.how = signature(RecordingClips).bind(*args, **settings)

    def setup(self, stage: str | None = None) -> None:
        """Open the recording.

        Raises:
            spikekit.SpikeFileError: the file cannot be read.
            ValueError: the recording is shorter than a clip, or an argument is out of range.
        """
        self.clips = RecordingClips(*self.how.args, **self.how.kwargs)

    def show(self, rgb: Tensor) -> Tensor:
        """Return light (3, H, W) in [0, 1], white being 1, as the camera shows it."""
        if self.clips.grey:
            rgb = (rgb * rgb.new_tensor([0.25, 0.5, 0.25])[:, None, None]).sum(0, keepdim=True).expand_as(rgb)
        camera = self.clips.recording.camera
        return rgb if camera is None else replace(camera, gain=1.0).display(rgb)

    def predict_dataloader(self) -> Iterable[dict[str, Any]]:  # noqa: D102
        if not self.trainer:
            return _Batches(self.clips, 0, 1)
        module = self.trainer.lightning_module
        process = self.trainer.global_rank, self.trainer.world_size
        return _Batches(self.clips, *process, module.future, module.interpolated, module.film_warm_up)
