"""Clips of a recording or a stream around its key frames."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from itertools import islice
from typing import TypeVar

import torch
from torch import Tensor

from spikekit import Calibration, bayer_sites, correct_spikes
from spikekit.arguments import frames_of
from spikekit.calibration.defects import find_outliers, replace_pixels
from spikekit.calibration.gain_spread import gain_spread
from spikekit.color.cfa import GREY
from spikekit.recording import Recording

Item = TypeVar("Item")

#: noise level above which weights for noisy sensors are better
NOISY = 0.3

#: default spike frames of a clip, and default distance of two pictures in spike frames
FRAMES, EVERY = 41, 20

# white level in spikes per frame below which frames are joined
_BRIGHT = 0.6

# spread of the gains at noise level 1, see configs/cameras.yaml, and the largest level that networks extrapolate to
_SPREAD, _MOST = 0.06, 1.5


class RecordingClips:
    """Clips around key frames of a recording, which is read once, from beginning to end.

    Args:
        recording: recording, as :func:`spikekit.recording.open_recording` returns it.
        frames: spike frames N of a clip.
        frame: key frames, the middle frames of the clips: N, or A to B - 1 as A:B or A:B:STEP; STEP is 20 by default.
            Default: all, 20 apart.
        crop_to: Bayer phase that the network takes; up to one row and one column are cropped to begin with it.

    Attributes:
        size: (H, W) of a clip.
        joined: number of consecutive spike frames that are joined into one, see :meth:`in_light`.
        chosen: key frames, in order.
    """

    def __init__(
        self, recording: Recording, frames: int = FRAMES, frame: str | None = None, crop_to: str = "RGGB"
    ) -> None:
        path, total, (rows, columns) = recording.path, recording.frames, recording.size
        if total < frames:
            raise ValueError(f"{path}: expected at least {frames} frames for a clip, got {total}")
        self.recording, self.frames, self.joined, self._asked = recording, frames, 1, (frame, crop_to)
        self.top = self.left = 0
        if recording.pattern != GREY and crop_to != GREY:  # the site of red identifies the phase
            phase = recording.pattern or "RGGB"
            (_, row, column), (_, to_row, to_column) = bayer_sites(phase)[0], bayer_sites(crop_to)[0]
            self.top, self.left = (row - to_row) % 2, (column - to_column) % 2
        self.size = rows - self.top, columns - self.left
        if min(self.size) < 3:
            raise ValueError(f"{path}: expected at least 3 x 3 pixels that begin with {crop_to}, got {self.size}")
        first, last = frames // 2, total - 1 - (frames - 1) // 2
        try:
            chosen = range(first, last + 1, EVERY) if frame is None else frames_of("frame", frame, first, last, EVERY)
        except ValueError as error:
            raise ValueError(f"{error}; a clip has {frames} frames of the {total} of {path}") from error
        self.chosen = list(chosen)

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def room(self) -> int:
        """Spike frames of the longest clip around the given first and last key frame; by default half the recording."""
        given, whole = (self._asked[0] or ":").split(":")[:2], self.recording.frames
        before = self.chosen[0] if given[0] else whole // 4
        after = whole - 1 - self.chosen[-1] if given[-1] else whole // 4
        return max(2 * min(before, after) + 1, self.frames)

    def in_light(self, white: float | None = None, room: int | None = None, join: bool = True) -> RecordingClips:
        """Return these clips with as many spike frames joined into one as the light requires.

        A joined frame has a spike where one of its frames has, as of a camera with a slower clock. Clips grow with the
        square root of the light that is missing, because motion grows as well. Decoders take all frames of clips that
        grow with the light that is missing, up to tenfold, as they need two spikes of a dark pixel.

        Args:
            white: white level in spikes per frame; default: :attr:`white`.
            room: longest clip in spike frames; default: :attr:`room`.
            join: join frames; False for decoders.
        """
        length, joined = clip_in_light(self.frames, white or self.white, room or self.room, join)
        clips = RecordingClips(self.recording, length, *self._asked)
        clips.joined = joined
        return clips

    def in_order(self, chosen: Iterable[int] | None = None, raw: bool = False) -> Iterator[tuple[int, Tensor]]:
        """Yield number and clip (N / joined, H, W), calibrated unless ``raw``, of key frames in order; default: all.

        Defects of unknown sensors are filled, see :func:`spikekit.fill_defects`.
        """
        middles = self.chosen if chosen is None else list(chosen)
        jump, phase = self.recording.frames_from, self.recording.bayer and self._asked[1]
        # .npz files are decompressed from their beginning, wherever reading begins
        packed = self.recording.path.suffix.lower() == ".npz"
        start = middles[0] - self.frames // 2 if middles else 0
        for middle, clip in clips_around(middles, self.frames, jump(start), start, None if packed else jump):
            clip = join_frames(clip[..., self.top :, self.left :], self.joined)
            clip = replace_pixels(clip, *self._defects) if self._unknown else clip
            yield middle, correct_spikes(clip, None if raw else self.calibration, phase)

    @cached_property
    def calibration(self) -> Calibration | None:
        """Calibration of the pixels of a clip, whose dark rate is that of a joined frame."""
        known = self.recording.calibration
        if known is None or (self.top, self.left, self.joined) == (0, 0, 1):
            return known
        dark = (self.joined * known.dark).clamp(max=1)
        return Calibration(*(plane[self.top :, self.left :] for plane in (known.gain, dark, known.defects)))

    @property
    def _unknown(self) -> bool:
        """Whether the sensor may be noisy: it was neither simulated nor declared ideal nor calibrated in the dark."""
        recording, measured = self.recording, self.recording.calibration
        return not recording.ideal and recording.alpha is None and (measured is None or not measured.dark.any())

    @cached_property
    def _defects(self) -> tuple[Tensor, Tensor]:
        """Dead and hot pixels of a clip, found in the whole recording, and the pixels that take their place, (H, W)."""
        rates, frames = self.recording.looks
        count = (frames * rates).sum(0)[self.top :, self.left :]
        dead, hot, other = find_outliers(count, frames * len(rates), self.recording.bayer)
        return dead | hot, other

    @property
    def white(self) -> float:
        """White level in spikes per frame: the side-car's, else what 99.9 % of the pixels do not exceed at any time."""
        return self.recording.alpha or self.recording.white

    @cached_property
    def gain_spread(self) -> float | None:
        """Spread of the gains: 0 for an ideal or calibrated sensor, ``None`` if it cannot be measured."""
        if not self._unknown:
            return 0.0
        rates, frames = self.recording.looks
        rates = replace_pixels(rates[..., self.top :, self.left :], *self._defects)
        return gain_spread(rates, frames, self.recording.pattern or "RGGB")

    @property
    def noise_level(self) -> float:
        """Noise level for networks: 0 for an ideal sensor, and 1 for that of the training or if it is not known."""
        level = 1.0 if self.gain_spread is None else min(self.gain_spread / _SPREAD, _MOST)
        return level * self.joined**0.5


def clip_in_light(frames: int, white: float, room: float = math.inf, join: bool = True) -> tuple[int, int]:
    """Return the spike frames of a clip and how many of them are joined, see :meth:`RecordingClips.in_light`."""
    missing = _BRIGHT / white
    best = round(missing**0.5 * min(FRAMES / frames, 1)) if join else round(min(missing, 10))
    times = int(max(min(best, room // frames), 1))
    return times * frames, times if join else 1


def join_frames(clip: Tensor, joined: int) -> Tensor:
    """Join consecutive spike frames of a clip (N, H, W)."""
    return clip if joined == 1 else clip.unflatten(0, (-1, joined)).amax(1)


def clips_around(
    middles: Iterable[int],
    length: int,
    frames: Iterator[Tensor],
    first: int = 0,
    jump: Callable[[int], Iterator[Tensor]] | None = None,
) -> Iterator[tuple[int, Tensor]]:
    """Yield number and clip of every key frame as soon as the last frame of the clip is read.

    Memory: ``length`` frames and a clip. The clips end with the key frames ``middles``, in order, or with the stream of
    ``frames`` (H, W), whose number begins at ``first``. ``jump`` returns the frames from a given number on; if given,
    frames between two clips are skipped.

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


def film_groups(items: Iterable[Item], first: int, size: int) -> Iterator[list[Item]]:
    """Yield the items of a film, one per picture, in groups that are made together; the first has its own size.

    Example:
        >>> [*film_groups("abcdefg", 1, 2)], [*film_groups("abcdefg", 3, 3)]
        ([['a'], ['b', 'c'], ['d', 'e'], ['f', 'g']], [['a', 'b', 'c'], ['d', 'e', 'f'], ['g']])
    """
    items = iter(items)
    group = list(islice(items, first))
    while group:
        yield group
        group = list(islice(items, size))
