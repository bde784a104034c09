"""Clips of a stream around the frames that pictures are made of."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from itertools import islice
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from spikekit import bayer_sites
from spikekit.arguments import frames_of
from spikekit.color.cfa import GREY
from spikekit.recording import Recording, white_rate

Item = TypeVar("Item")

#: spike frames of a clip, and frames between two pictures, where nothing else is said
FRAMES, EVERY = 41, 20

# clips that are looked at for what is white, from the first to the last of the recording
_LOOKS = 8


class RecordingClips:
    """Clips around some frames of a recording, which is read once, from its beginning to its end.

    Args:
        recording: as :func:`spikekit.recording.open_recording` gives it.
        frames: spike frames N of a clip, as the network takes them.
        frame: which frames are in the middle of clips: N, or from A to B - 1 as A:B or A:B:STEP, 20 apart where STEP is
            left out; all, 20 apart, when not given.
        crop_to: Bayer phase that the network takes; clips begin with it, a row and a column less at most.

    Attributes:
        size: (H, W) of a clip.
        chosen: the frames in the middle of the clips, in order.

    Raises:
        ValueError: the recording is shorter than a clip, less than 3 x 3 pixels are left, or frames that are not there.
    """

    def __init__(
        self, recording: Recording, frames: int = FRAMES, frame: str | None = None, crop_to: str = "RGGB"
    ) -> None:
        path, total, (rows, columns) = recording.path, recording.frames, recording.size
        if total < frames:
            raise ValueError(f"{path}: expected at least {frames} frames for a clip, got {total}")
        self.recording, self.frames = recording, frames
        self.top = self.left = 0
        if recording.pattern != GREY and crop_to != GREY:  # where red is says which of the four phases it is
            phase = recording.pattern or "RGGB"
            (_, row, column), (_, to_row, to_column) = bayer_sites(phase)[0], bayer_sites(crop_to)[0]
            self.top, self.left = (row - to_row) % 2, (column - to_column) % 2
        self.size = rows - self.top, columns - self.left
        if min(self.size) < 3:
            raise ValueError(f"{path}: expected at least 3 x 3 pixels that begin with {crop_to}, got {self.size}")
        first, last = frames // 2, total - 1 - (frames - 1) // 2
        try:
            chosen = range(first, last + 1, EVERY) if frame is None else frames_of(frame, first, last, EVERY)
        except ValueError as error:
            raise ValueError(f"frame: {error}; a clip has {frames} frames of the {total} of {path}") from error
        self.chosen = list(chosen)

    def __len__(self) -> int:
        return len(self.chosen)

    def in_order(self, chosen: Iterable[int] | None = None) -> Iterator[tuple[int, Tensor]]:
        """Yield the number and the clip (N, H, W) of some frames, which increase; of all chosen ones when not given."""
        middles = self.chosen if chosen is None else list(chosen)

        def jump(start: int) -> Iterator[Tensor]:
            return self.recording.frames_from(start)

        # what is packed is unpacked from its beginning, wherever reading begins
        packed = self.recording.path.suffix.lower() == ".npz"
        start = middles[0] - self.frames // 2 if middles else 0
        for middle, clip in clips_around(middles, self.frames, jump(start), start, None if packed else jump):
            yield middle, self.recording.correct_spikes(clip)[..., self.top :, self.left :]

    @cached_property
    def white(self) -> float:
        """Spikes a frame of a white pixel: the side-car's, or else what 99.9 % of the pixels do not exceed."""
        if self.recording.alpha is not None:
            return self.recording.alpha
        clips = range(self.frames // 2, self.recording.frames - (self.frames - 1) // 2, EVERY)
        looks = sorted({clips[round(n)] for n in np.linspace(0, len(clips) - 1, _LOOKS)})
        return white_rate(torch.stack([clip.float().mean(0) for _, clip in self.in_order(looks)]).mean(0))


def clips_around(
    middles: Iterable[int],
    length: int,
    frames: Iterator[Tensor],
    first: int = 0,
    jump: Callable[[int], Iterator[Tensor]] | None = None,
) -> Iterator[tuple[int, Tensor]]:
    """Yield every key frame's number and clip, as soon as the clip's last frame has come.

    At most ``length`` frames are held, beside a clip.

    Args:
        middles: numbers of the key frames, increasing, the first of them ``length // 2`` behind ``first`` or later.
        length: frames of a clip.
        frames: the stream's frames (H, W), one after the other.
        first: number of the first of them.
        jump: gives the frames from a number on, where a stream can leave out those between two clips.

    Returns:
        An iterator over numbers and clips (length, H, W), which ends with the middles or with the stream.

    Example:
        >>> frames = iter(torch.arange(9.0).reshape(9, 1, 1))
        >>> [(middle, clip.flatten().tolist()) for middle, clip in clips_around([1, 4, 8], 3, frames)]
        [(1, [0.0, 1.0, 2.0]), (4, [3.0, 4.0, 5.0])]
    """
    held: deque[Tensor] = deque(maxlen=length)
    at = first
    for middle in middles:
        start = middle - length // 2
        if jump is not None and start > at:
            frames, at = jump(start), start
        while at < start + length:
            frame = next(frames, None)
            if frame is None:
                return
            held.append(frame)
            at += 1
        yield middle, torch.stack(tuple(held))


def film_groups(items: Iterable[Item], future: int = 0, interpolated: int = 0) -> Iterator[list[Item]]:
    """Yield the clips of a film, or what stands for them, group by group, each ending with a picture of the network.

    Args:
        items: of every picture, in order.
        future: key frames that a picture may wait for.
        interpolated: pictures between two that the network makes; there are none before the first.

    Example:
        >>> [*film_groups("abcdefg", interpolated=1)], [*film_groups("abcdefg", future=1, interpolated=1)]
        ([['a'], ['b', 'c'], ['d', 'e'], ['f', 'g']], [['a', 'b', 'c'], ['d', 'e', 'f', 'g']])
    """
    items, size = iter(items), (future + 1) * (interpolated + 1)
    group = list(islice(items, size - interpolated))
    while group:
        yield group
        group = list(islice(items, size))
