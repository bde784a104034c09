"""Clips simulated from frame sequences: REDS, Vid4, Vimeo-90K, or any folder of frames."""

from __future__ import annotations

import hashlib
import pickle
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import Dataset

from lightning_modules.data.cache import ClipCache, clip_key, file_digest, pack_clip, unpack_clip
from lightning_modules.data.layouts import EXPECTED, Collection, SequenceFiles, find_sequences
from lightning_modules.data.loading import ClipScenes, cut_key_frames, flow_margin, trim
from lightning_modules.data.pictures import split_pictures
from lightning_modules.signatures import inherit_signature
from spikekit import VideoError, bin_to_sensor
from spikekit.check import check_positive, check_size, check_whole
from spikekit.color.cfa import GREY, cfa_pattern
from spikekit.flow.interpolate import FlowInterpolation
from spikekit.io.failures import reading
from spikekit.io.video import read_video
from spikekit.scenes.frame_sequence import SIMULATOR_VERSION, FrameSequence, SequenceClip
from spikekit.sensor.noise import SensorNoise


@dataclass(frozen=True)
class ClipRecipe:
    """Settings that simulate clips from frame sequences; the same frames always give the same clip.

    Args:
        scale: super-resolution factor.
        frames: spike frames of a clip. The ground truth is the source frame at spike frame ``frames // 2``.
        pattern: Bayer phase of the sensor, RGGB, BGGR, GRBG or GBRG; or grey, with a ground truth of one channel.
        alpha: light of a white pixel per clock; the threshold of charge is 1.
        clocks: spike frames from one source frame to the next.
        key_frames: number of consecutive source frames with a clip around each, odd. With more than one, all of them
            are ground truth, and there is no flow.
        flow_times: spike frames to which the flow from the middle frame is given; empty for no flow.
        interpolation: class path of the interpolation between source frames; null for motion-compensated
            interpolation without weights. Delete the cache after changes to code of your own.
        noise: noise of the sensor, such as ``{photons: 1000}``; null for none.
        seed: random seed.

    Raises:
        ValueError: an argument is out of range; the message names it.
    """

    scale: int = 4
    frames: int = 41
    pattern: str = "RGGB"
    alpha: float = 0.4
    clocks: int = 20
    key_frames: int = 1
    flow_times: tuple[int, ...] = (5, 35)
    interpolation: Callable[[Tensor, Tensor], Any] | None = None
    noise: SensorNoise | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        own = {"interpolation": self.interpolation or FlowInterpolation(), "noise": self.noise or SensorNoise()}
        for name, value in {"scale": check_whole("scale", self.scale), **own}.items():
            object.__setattr__(self, name, value)  # frozen
        check_positive("alpha", self.alpha)
        check_whole("frames", self.frames)
        check_whole("clocks", self.clocks)
        object.__setattr__(self, "pattern", cfa_pattern(self.pattern))
        if check_whole("key_frames", self.key_frames) % 2 == 0:
            raise ValueError(f"key_frames: expected an odd number, got {self.key_frames}")
        if any(not 0 <= time < self.frames for time in self.flow_times):
            raise ValueError(f"flow_times: expected clocks in [0, {self.frames}), got {self.flow_times}")
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {self.seed}")

    @property
    def reach(self) -> tuple[int, int]:
        """Source frames that a clip needs before and after its middle frame."""
        more = self.key_frames // 2
        return -(-(self.frames // 2) // self.clocks) + more, -(-((self.frames - 1) // 2) // self.clocks) + more

    def files(self, sequence: SequenceFiles, middle: int) -> list[Path]:
        """Return the files that a clip is made of; a separate file of ground truth is the last."""
        before, after = self.reach
        paths = [sequence.folder / name for name in sequence.frames[middle - before : middle + after + 1]]
        return paths if sequence.truth is None else [*paths, sequence.truth / sequence.frames[middle]]

    def key(self, sequence: SequenceFiles, middle: int) -> str:
        """Return the key of a clip in a cache."""
        return clip_key(
            simulator=SIMULATOR_VERSION,
            files=[file_digest(path) for path in self.files(sequence, middle)],
            shrink=sequence.shrink,
            interpolation=hashlib.sha256(pickle.dumps(self.interpolation)).hexdigest(),
            noise=asdict(self.noise),
            pattern=self.pattern,
            flow_times=list(self.flow_times),
            **{name: getattr(self, name) for name in ("scale", "frames", "alpha", "clocks", "key_frames", "seed")},
        )

    def clip(self, sequence: SequenceFiles, middle: int) -> dict[str, Tensor]:
        """Simulate a clip around a source frame.

        Returns:
            ``spikes`` uint8 (N, H, W), the ground truth ``rgb`` (3, s H, s W), and ``flow`` (times, 2, H, W) in sensor
            pixels, all of the whole view. The flow is 0 across a cut of the film. With K key frames, ``spikes`` holds
            all their spike frames and ``rgb`` is (K, 3, s H, s W).
        """
        clip, paths = self.view(sequence, middle), self.files(sequence, middle)
        # the seed of the sensor depends on the content of the frames, not on their paths
        chance = int(clip_key(seed=self.seed, files=[file_digest(path) for path in paths])[:15], 16)
        spikes = torch.cat(list(clip.sequence.spikes(clip.first, clip.frames, noise=self.noise, seed=chance)))
        if self.key_frames > 1:
            around = range(-(self.key_frames // 2), self.key_frames // 2 + 1)
            rgb = torch.stack([clip.rgb(clip.middle + n * self.clocks) for n in around])
            return {"spikes": spikes, "rgb": self._seen(rgb)}
        rgb = clip.rgb(clip.middle) if sequence.truth is None else _truth(paths[-1], self.scale, spikes)
        made = {"spikes": spikes, "rgb": self._seen(rgb)}
        if self.flow_times:
            made["flow"] = torch.stack([self._flow(clip, time) for time in self.flow_times])
        return made

    def _seen(self, rgb: Tensor) -> Tensor:
        """Return the colours, or for a grey sensor their luminance, (*, 1, s H, s W)."""
        return bin_to_sensor(rgb, GREY, scale=1).unsqueeze(-3) if self.pattern == GREY else rgb

    def view(self, sequence: SequenceFiles, middle: int) -> SequenceClip:
        """Return the view of the camera around a source frame; raises the errors of :meth:`clip`."""
        paths = self.files(sequence, middle)[: sum(self.reach) + 1]
        frames = [_shrunk(read_video(path)[0], sequence.shrink) for path in paths]
        for path, rgb in zip(paths, frames, strict=True):
            check_size(path, rgb.shape[1:], frames[0].shape[1:], f" (H x W) as {paths[0]}", VideoError)
        scale = self.scale if sequence.truth is None else 1
        names = "pattern", "alpha", "clocks", "interpolation"
        with reading(sequence.folder, VideoError):  # raised in a worker, any other error would be a traceback
            seen = FrameSequence(frames, scale=scale, **{name: getattr(self, name) for name in names})
        return seen.clip(self.reach[0], self.frames + (self.key_frames - 1) * self.clocks)

    def _flow(self, clip: SequenceClip, time: int) -> Tensor:
        try:
            return clip.flow(time)
        except ValueError:
            if not isinstance(self.interpolation, FlowInterpolation):
                raise
            return torch.zeros(2, clip.height // clip.sequence.scale, clip.width // clip.sequence.scale)  # across a cut


def _shrunk(rgb: Tensor, factor: int) -> Tensor:
    """Reduce a picture as usual for super-resolution: bicubic, rounded to 8 bits."""
    if factor == 1:
        return rgb
    height, width = (length // factor for length in rgb.shape[1:])
    rgb = rgb[None, :, : height * factor, : width * factor]
    small = F.interpolate(rgb, (height, width), mode="bicubic", antialias=True)[0]
    return small.mul(255).round().clamp(0, 255).div(255)


def _truth(path: Path, scale: int, spikes: Tensor) -> Tensor:
    rgb, wanted = read_video(path)[0], [scale * length for length in spikes.shape[1:]]
    # the view is cropped to whole Bayer cells
    if not all(0 <= length - side < 2 * scale for length, side in zip(rgb.shape[1:], wanted, strict=True)):
        expected, got = (f"{height} x {width}" for height, width in (wanted, rgb.shape[1:]))
        raise VideoError(f"{path}: expected {expected}, {scale} times the frames that the sensor sees, got {got}")
    return rgb[:, : wanted[0], : wanted[1]]


class SequenceClips(Dataset):
    """Clips around frames of sequences.

    The possible middle frames of a sequence are divided into equal parts, one per clip. A whole clip is around the
    middle of its part. Patches are around a frame of the part that the seed fixes, so that a cache can hold all clips.
    They are shuffled in every round, each time at another place with even offsets, which keep the Bayer phase. Seed and
    index determine a clip, in any process and order.
    Short sequences give fewer clips, and those with a fixed middle frame one.

    Spikes have at least the side ``flow_patch``, for the estimate of motion: they reach beyond the patch accordingly,
    within the view; ground truth and flow cover the patch. Sides are in sensor pixels.
    """

    def __init__(
        self,
        sequences: Sequence[SequenceFiles],
        recipe: ClipRecipe,
        clips: int = 1,
        patch: int | None = None,
        cache: ClipCache | None = None,
        flow_patch: int = 0,
    ) -> None:
        self.recipe, self.patch, self.cache, self.flow_patch = recipe, patch, cache, flow_patch
        check_whole("clips", clips)
        if patch is not None:
            check_whole("patch", patch)
        if not sequences:
            raise ValueError("sequences: expected at least one, got none")
        self.places = [(sequence, *part) for sequence in sequences for part in self._parts(sequence, clips)]

    def _parts(self, sequence: SequenceFiles, clips: int) -> list[tuple[int, int]]:
        before, after = self.recipe.reach
        count, needed = len(sequence.frames) - before - after, before + after + 1
        if count < 1:
            raise ValueError(
                f"{sequence.folder}: expected at least {needed} frames for a clip, got {len(sequence.frames)}"
            )
        if sequence.middle is not None:
            return [(sequence.middle, sequence.middle + 1)]
        clips = min(clips, count)
        return [(before + part * count // clips, before + (part + 1) * count // clips) for part in range(clips)]

    def __len__(self) -> int:
        return len(self.places)

    @property
    def names(self) -> list[str]:
        """Names of sequence and middle frame of every clip."""
        places = (self.place(index) for index in range(len(self)))
        return [f"{sequence.name}/{Path(sequence.frames[middle]).stem}" for sequence, middle in places]

    def place(self, index: int) -> tuple[SequenceFiles, int]:
        """Return the sequence and the middle frame of a clip, before patches are shuffled."""
        sequence, first, end = self.places[index]
        if self.patch is None:
            return sequence, (first + end) // 2
        rng = np.random.default_rng([self.recipe.seed, zlib.crc32(sequence.name.encode()), first])
        return sequence, int(rng.integers(first, end))

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """Return a clip, see :meth:`ClipRecipe.clip`; patches have no last index."""
        if self.patch is None:
            return self._clip(*self.place(index), None)
        turn, index_in_turn = divmod(index, len(self))
        order = np.random.default_rng([self.recipe.seed, turn]).permutation(len(self))
        place = self.place(int(order[index_in_turn]))
        return self._clip(*place, np.random.default_rng([self.recipe.seed, index, 1]))

    def _clip(self, sequence: SequenceFiles, middle: int, rng: np.random.Generator | None) -> dict[str, Tensor]:
        if self.cache is None:
            packed = pack_clip(self.recipe.clip(sequence, middle))
        else:
            key = self.recipe.key(sequence, middle)
            packed = self.cache.packed(key, lambda: self.recipe.clip(sequence, middle))
        scale = self.recipe.scale
        height, width = (length // scale for length in packed["rgb"].shape[-2:])
        part, margin = (0, 0, height, width), 0
        if rng is not None:
            if self.patch > min(height, width):
                raise VideoError(
                    f"patch: expected at most {min(height, width)}, as {sequence.folder} gives {height} x {width} "
                    f"sensor pixels at scale {scale}, got {self.patch}"
                )
            margin = min(flow_margin(self.patch, self.flow_patch), (min(height, width) - self.patch) // 4 * 2)
            side = self.patch + 2 * margin
            corner = (2 * int(rng.integers((length - side) // 2 + 1)) for length in (height, width))
            part = *corner, side, side
        clip = unpack_clip(packed, part, scale)
        inner = {"rgb": scale * margin, "flow": margin}
        clip = {name: trim(planes, inner.get(name, 0)) for name, planes in clip.items()}
        return cut_key_frames(clip, self.recipe.key_frames, self.recipe.frames, self.recipe.clocks)


class FilmScenes(ClipScenes):
    """Clips of frame sequences, seen by a simulated camera: REDS, Vid4, Vimeo-90K, or any folder of frame folders.

    The data set is recognised by the files in ``root``. REDS (120 fps) has 240 scenes for training and 30 for
    validation and test, with 5 clips each. Vid4 is for tests. Vimeo-90K requires scale 4: the camera sees its
    low-resolution sequences, which are the official ones of its test set, those of a folder ``BIx4`` beside
    ``sequences``, or computed; the ground truth is the full-size middle frame. Of other films, one in twenty is for
    validation, and all are for tests.

    Training uses patches, validation and test whole views, cropped at the bottom and right to multiples of twice the
    scale. Patches need a simulation of the whole view, which takes seconds for large frames: use a ``cache``.

    All arguments of :class:`~lightning_modules.data.sequences.ClipRecipe` are accepted as well.

    Args:
        root: folder of the unpacked data set.
        patch: side of a training clip in sensor pixels.
        clips: clips per sequence, spread over it. Null for 5 (REDS and other films) or 1 (Vid4, Vimeo-90K).
        flow: include the flow of the interpolation from the middle to ``flow_times``. False for an interpolation
            without flow; training then uses the network's own estimator.
        flow_times: spike frames to which the flow is given.
        flow_patch: smallest side, in sensor pixels, for the estimate of motion in training, see :class:`StillScenes`.
        cache: folder of simulated clips, which are identified by the content of their frames, all settings and the
            version of the simulator. It is never emptied; files can be deleted at any time. Null for none.
        batch_size: training clips in a batch; validation and test use 1.
        workers: processes that make clips. Null for all cores but one, at most sixteen.
        seed: random seed; the clips do not depend on the number of workers.
    """

    @inherit_signature(ClipRecipe)
    def __init__(
        self,
        root: str,
        *,
        patch: int = 96,
        clips: int | None = None,
        flow: bool = True,
        flow_times: tuple[int, int] = (5, 35),
        flow_patch: int = 0,
        cache: str | None = None,
        batch_size: int = 4,
        workers: int | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(batch_size, 1, workers)
        self.root, self.patch, self.clips, self.cache, self.flow_patch = root, patch, clips, cache, flow_patch
        self.seed = seed
        self.options = {**options, "flow_times": tuple(flow_times) if flow else (), "seed": seed}
        self.found: Collection | None = None

    def setup(self, stage: str | None = None) -> None:
        """Find the sequences.

        Args:
            stage: ``fit``, ``validate`` or ``test``, whose sequences must exist; default: no check.

        Raises:
            FileNotFoundError: the folder, or the sequences for the stage, do not exist; the message shows the expected
                layouts.
            OSError: the cache folder cannot be made.
            ValueError: an argument is out of range, or a sequence is too short for a clip.
        """
        recipe = ClipRecipe(**self.options)
        check_whole("batch_size", self.batch_size)
        if self.found is None:
            self.found = find_sequences(self.root, lambda found: split_pictures(found, self.seed))
        found = self.found
        if found.scale not in (None, recipe.scale):
            raise ValueError(
                f"scale: expected {found.scale} with {found.name}, whose small frames are the full ones divided by "
                f"{found.scale}, got {recipe.scale}"
            )
        needed = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",)}.get(stage, ())
        missing = [split for split in needed if not getattr(found, split)]
        if missing:
            raise FileNotFoundError(
                f"{self.root}: {found.name} without sequences for {stage} ({missing[0]}); expected one of\n{EXPECTED}"
            )
        clips, cache = self.clips or found.clips, self.cache and ClipCache(self.cache)
        if found.train:
            self.train_set = SequenceClips(found.train, recipe, clips, self.patch, cache or None, self.flow_patch)
            self.train_clips = len(self.train_set)
        if found.val:
            self.val_set = SequenceClips(found.val, recipe, clips, None, cache or None)
        if found.test:
            self.test_set = SequenceClips(found.test, recipe, clips, None, cache or None)
            self.test_names = self.test_set.names
        if stage == "fit" and self.train_clips < self.batch_size:
            raise ValueError(
                f"batch_size: expected at most the {self.train_clips} training clips of {self.root}, got "
                f"{self.batch_size}"
            )
