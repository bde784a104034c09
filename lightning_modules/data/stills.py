"""Clips from still pictures in motion, with exact ground truth and flow, for training and validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import Dataset

from lightning_modules.data.cache import ClipCache, clip_key, file_digest, unpack_clip
from lightning_modules.data.loading import ClipScenes, cut_key_frames
from lightning_modules.data.margin import flow_margin, trim
from lightning_modules.data.pictures import cached_picture, embedded_pictures, folder_pictures, split_pictures
from lightning_modules.data.textures import outline_mask, texture
from lightning_modules.signatures import takes
from spikekit import bin_to_sensor
from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import GREY, cfa_pattern
from spikekit.scenes import analytic
from spikekit.scenes.analytic import Layer, Motion, Scene
from spikekit.scenes.frame_sequence import SIMULATOR_VERSION
from spikekit.sensor.noise import SensorNoise
from spikekit.sensor.simulate import simulate_spikes

#: what says how a clip looks, besides the sensor
_CODE = [Path(__file__).with_name(f"{name}.py") for name in ("stills", "textures", "pictures")] + [
    Path(analytic.__file__)
]
_TEXTURES = 0.3  # share of procedural pictures among embedded ones


@dataclass(eq=False, repr=False)
class StillClips(Dataset):
    """Clips of random scenes; which one, only the seed and the index say, in whatever process and order.

    Args:
        pictures: files to make scenes of.
        scale: super-resolution factor: how many view pixels a sensor pixel is wide.
        patch: side of the clip in sensor pixels.
        frames: spike frames of a clip. The truth is the view at frame ``frames // 2``.
        pattern: Bayer phase of the sensor: RGGB, BGGR, GRBG or GBRG; or grey, whose truth has one channel.
        alpha: light of a white pixel per clock; a threshold of charge is 1.
        motion: largest displacement of the background, at its centre, from the middle frame to the first or last one,
            in sensor pixels. An object moves by up to as much again relative to the background.
        bend: what acceleration adds to that displacement at most, in sensor pixels, for the background and for each
            object: paths are parabolas instead of straight lines.
        rotation: largest turn of the background and of each object in that time, in degrees.
        zoom: largest growth or shrinkage of the background and of each object in that time; 0.01 is one per cent.
        objects: most objects that move in front of the background.
        brightness: darkest and brightest exposure. Truth and light of a clip are both multiplied by one number between.
        photons: photons that make one threshold, for photon noise; null for none.
        noise: instead, what a sensor adds, such as ``{photons: 3000, gain_spread: 0.06}``; a clip with ``augment``, as
            training clips are, has a random share of it: a network learns sensors from the ideal to this one. The
            share is the clip's ``noise``.
        gains: lowest and highest alpha of clips with ``augment``, all orders of magnitude between alike; it is the
            clip's ``alpha``. Null for one alpha.
        flow_times: frames to which the flow from the middle frame is given; with 41 frames and a window of 11, 5 and 35
            are the centres of the first and of the last window.
        key_frames: clips that follow each other, of one scene, for a network that makes films.
        every: frames from the middle of one to the middle of the next.
        seed: where chance begins.
        augment: mirror, turn and recolour the pictures. Without it the pictures take their turns, one an index.
        textures: take some of the pictures from :func:`lightning_modules.data.textures.texture`.
        length: what ``len`` says; any index from 0 on can be had.
        flow_patch: smallest side of the spikes, which reach beyond the patch as far as that takes, for an estimate of
            motion; the truth and the flow are those of the patch.
        cache: where clips are kept; None to make each whenever it is asked for.

    Raises:
        ValueError: an argument that makes no sense; the message names it.
    """

    pictures: Sequence[Path]
    _: KW_ONLY
    scale: int = 4
    patch: int = 96
    frames: int = 41
    pattern: str = "RGGB"
    alpha: float = 0.4
    motion: float = 3.0
    bend: float = 0.0
    rotation: float = 1.0
    zoom: float = 0.01
    objects: int = 2
    brightness: tuple[float, float] = (0.5, 1.0)
    photons: float | None = None
    noise: SensorNoise | None = None
    gains: tuple[float, float] | None = None
    flow_times: tuple[int, int] = (5, 35)
    key_frames: int = 1
    every: int = 20
    seed: int = 0
    augment: bool = True
    textures: bool = False
    length: int = 1200
    flow_patch: int = 0
    cache: ClipCache | None = None

    def __post_init__(self) -> None:
        self.pictures, self.brightness = list(self.pictures), tuple(self.brightness)
        self.gains = self.gains and tuple(self.gains)
        self.flow_times, self.margin = tuple(self.flow_times), flow_margin(self.patch, self.flow_patch)
        _check(self)
        self.clocks = self.frames + (self.key_frames - 1) * self.every

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """Return a clip: ``spikes`` uint8 (N, H, W), ``rgb`` (3, s h, s w) and ``flow`` (times, 2, h, w) float32.

        H and W are h and w, those of the patch, unless motion is to be estimated on more. Several key frames K have
        ``spikes`` (K, N, H, W), ``rgb`` (K, 3, s h, s w) and ``every``, and no flow. The gain is ``alpha``, where there
        are ``gains``, and the level of the noise ``noise``, where there is any.
        """
        return self._camera(index) | self._clip(index)

    def _clip(self, index: int) -> dict[str, Tensor]:
        if self.cache is None:
            return self._cut(self._make(index))
        packed = self.cache.packed(clip_key(source=self._source, index=index), lambda: self._make(index))
        side = self.patch + 2 * self.margin
        return self._cut(unpack_clip(packed, (0, 0, side, side), self.scale))

    @cached_property
    def _source(self) -> str:
        """Digest of all that a clip is made of, besides its index."""
        aside = {"pictures", "length", "cache"}
        options = {name: value for name, value in vars(self).items() if name not in aside}
        options["noise"] = self.noise and asdict(self.noise)
        files = [file_digest(path) for path in (*_CODE, *self.pictures)]
        return clip_key(simulator=SIMULATOR_VERSION, files=files, **options)

    def _make(self, index: int) -> dict[str, Tensor]:
        """Spikes of all key frames, (T, H, W), and truth, or flow and truth of the one."""
        scene = self.scene(index)
        spikes = self.spikes(index, scene)
        middles = [self.frames // 2 + n * self.every for n in range(self.key_frames)]
        rgb = torch.stack([trim(scene.rgb(middle), self.scale * self.margin) for middle in middles])
        if self.key_frames > 1:
            return {"spikes": spikes, "rgb": rgb}
        flow = torch.stack([scene.flow(clock, scale=self.scale) for clock in self.flow_times])
        return {"spikes": spikes, "rgb": rgb[0], "flow": trim(flow, self.margin)}

    def _cut(self, clip: dict[str, Tensor]) -> dict[str, Tensor]:
        return cut_key_frames(clip, self.key_frames, self.frames, self.every)

    def _camera(self, index: int) -> dict[str, Tensor]:
        """Gain and level of the noise of a clip, where they are not always the same."""
        rng = self._rng(index, "spikes")
        rng.integers(2**63)  # of the charge
        told = {}
        if self.noise is not None:
            told["noise"] = torch.tensor(1 - rng.uniform() if self.augment else 1.0)
        if self.gains is not None:
            low, high = np.log(self.gains)
            told["alpha"] = torch.tensor(np.exp(rng.uniform(low, high)) if self.augment else self.alpha)
        return {name: value.float() for name, value in told.items()}

    def spikes(self, index: int, scene: Scene) -> Tensor:
        """Return what the sensor makes of the scene of a clip, uint8 (clocks, H, W)."""
        camera = self._camera(index)
        light = scene.light(self.pattern, scale=self.scale, alpha=float(camera.get("alpha", self.alpha)))
        generator = torch.Generator().manual_seed(int(self._rng(index, "spikes").integers(2**63)))
        noise = self.noise or SensorNoise(photons=self.photons)
        if self.noise and self.augment:
            noise = noise.scaled(float(camera["noise"]))
        return simulate_spikes(light, noise=noise, generator=generator)

    def scene(self, index: int) -> Scene:
        """Return the scene of a clip, to look at other clocks or sizes than the clip has."""
        rng = self._rng(index, "scene")
        side, half = self.scale * (self.patch + 2 * self.margin), max(self.frames // 2, 1)
        brightness = rng.uniform(*self.brightness)
        middle = (side - 1) / 2
        velocity = _in_disc(rng) * self.motion * self.scale / half

        # what comes into view: the corners by motion, rotation and zoom
        longer = (self.clocks // 2) / half if self.key_frames > 1 else 1
        turns = middle * math.sqrt(2) * (math.radians(self.rotation) + self.zoom)
        reach = turns * longer + (self.motion * longer + self.bend * longer**2) * self.scale
        margin = math.ceil(reach) + 2
        background = self._picture(side + 2 * margin, rng, index) * brightness
        layers = [Layer(background, self._motion(velocity, (middle, middle), half, rng), (-margin, -margin))]
        for _ in range(rng.integers(self.objects + 1)):
            size = max(4, round(side * rng.uniform(0.15, 0.5)))
            picture = self._picture(size, rng) * brightness
            x, y = (int(corner) for corner in rng.integers(-size // 2, side - size // 2, 2))
            moves = velocity + _in_disc(rng) * self.motion * self.scale / half
            centre = (x + (size - 1) / 2, y + (size - 1) / 2)
            layers.append(Layer(picture, self._motion(moves, centre, half, rng), (x, y), outline_mask(size, rng)))
        return Scene(layers, side, side, self.clocks)

    def _rng(self, index: int, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.augment, index, purpose == "spikes"])

    def _motion(self, velocity: np.ndarray, centre: tuple[float, float], half: int, rng: np.random.Generator) -> Motion:
        rotation = math.radians(self.rotation * rng.uniform(-1, 1)) / half
        zoom = (1 + self.zoom) ** (rng.uniform(-1, 1) / half)
        # without a bend nothing is drawn: a seed's clips stay what they were
        bend = _in_disc(rng) * (2 * self.bend * self.scale / half**2) if self.bend else np.zeros(2)
        return Motion(_pair(velocity), rotation, zoom, centre, _pair(bend))

    def _picture(self, side: int, rng: np.random.Generator, turn: int | None = None) -> Tensor:
        """A random square out of a picture: ``turn`` says whose turn it is, where pictures take turns."""
        picture = self._rgb(side, rng, turn)
        return bin_to_sensor(picture, GREY, scale=1)[None] if self.pattern == GREY else picture

    def _rgb(self, side: int, rng: np.random.Generator, turn: int | None) -> Tensor:
        if self.textures and rng.uniform() < _TEXTURES:
            return texture(side, side, rng)
        if self.augment or turn is None:
            turn = int(rng.integers(len(self.pictures)))
        picture = cached_picture(self.pictures[turn % len(self.pictures)])
        if self.augment:
            return _augment(_crop(picture, side, rng, mirror=1.25), rng)
        return _crop(picture, side, rng, mirror=1.0)


def _check(clips: StillClips) -> None:
    clips.scale = check_whole("scale", clips.scale)
    check_positive("alpha", clips.alpha)
    clips.pattern = cfa_pattern(clips.pattern)
    low, high = clips.brightness
    for name, good, expected in (
        ("pictures", len(clips.pictures) > 0, "at least one"),
        ("patch", clips.patch >= 1, "at least 1"),
        ("frames", clips.frames >= 1, "at least 1"),
        ("motion", 0 <= clips.motion < math.inf, "0 or more"),
        ("bend", 0 <= clips.bend < math.inf, "0 or more"),
        ("rotation", 0 <= clips.rotation < math.inf, "0 or more degrees"),
        ("zoom", 0 <= clips.zoom < math.inf, "0 or more"),
        ("objects", clips.objects >= 0, "0 or more"),
        ("brightness", 0 <= low <= high < math.inf, "two numbers 0 <= low <= high"),
        ("key_frames", clips.key_frames >= 1, "at least 1"),
        ("every", clips.every >= 1, "at least 1 clock"),
        ("flow_times", all(0 <= t < clips.frames for t in clips.flow_times), f"clocks in [0, {clips.frames})"),
        ("photons", clips.photons is None or 1 <= clips.photons < math.inf, "1 or more, or null for no noise"),
        (
            "gains",
            clips.gains is None or (len(clips.gains) == 2 and 0 < clips.gains[0] <= clips.gains[1] < math.inf),
            "two numbers 0 < low <= high, or null",
        ),
        ("photons", None in (clips.photons, clips.noise), "those of the noise instead"),
        ("seed", clips.seed >= 0, "0 or more"),
        ("length", clips.length >= 1, "at least 1 clip"),
    ):
        if not good:
            raise ValueError(f"{name}: expected {expected}, got {getattr(clips, name)}")


def _pair(vector: np.ndarray) -> tuple[float, float]:
    return float(vector[0]), float(vector[1])


def _in_disc(rng: np.random.Generator) -> np.ndarray:
    """(x, y) in the unit disc: any direction, any length, all equally likely."""
    angle, length = rng.uniform(0, 2 * math.pi), rng.uniform()
    return length * np.array([math.cos(angle), math.sin(angle)])


def _crop(picture: Tensor, side: int, rng: np.random.Generator, mirror: float) -> Tensor:
    """Cut a square at a random place and size; where the picture ends, it is mirrored.

    The square is at most ``mirror`` times as long as the picture, as far as that is to be had without enlarging.
    """
    # Shrinking makes grain small and edges sharp. Enlarging blurs: only a picture below half the square's side is.
    shortest = min(picture.shape[1:])
    smallest = max(0.5, min(1.0, side / (mirror * shortest)), side / (2 * shortest))
    factor = math.exp(rng.uniform(math.log(smallest), math.log(max(smallest, 1.0))))
    for axis in (1, 2):
        length = min(math.ceil(side / factor), picture.shape[axis])
        picture = picture.narrow(axis, int(rng.integers(picture.shape[axis] - length + 1)), length)
    size = [max(1, round(length * factor)) for length in picture.shape[1:]]
    picture = F.interpolate(picture[None], size, mode="bicubic", antialias=True)[0].clamp(0, 1)
    for axis in (1, 2):
        length = picture.shape[axis]
        index = (torch.arange(side) + int(rng.integers(max(length - side, 0) + 1))) % (2 * length)
        picture = picture.index_select(axis, torch.minimum(index, 2 * length - 1 - index))
    return picture


def _augment(picture: Tensor, rng: np.random.Generator) -> Tensor:
    """Mirror and turn at random; rarely, swap colours, or tint what is grey."""
    flips = [axis for axis in (1, 2) if rng.uniform() < 0.5]
    picture = picture.flip(flips).rot90(int(rng.integers(4)), (1, 2))
    if rng.uniform() < 0.1:
        picture = picture[torch.from_numpy(rng.permutation(3))]
    dark, bright = np.sort(rng.uniform(0, 1, (2, 3)) ** [[2.0], [0.5]], axis=0)
    if rng.uniform() < 0.5 and torch.equal(picture[0], picture[1]) and torch.equal(picture[0], picture[2]):
        dark, bright = (torch.from_numpy(ends).float()[:, None, None] for ends in (dark, bright))
        picture = dark + (bright - dark) * picture
    return picture.contiguous()


class StillScenes(ClipScenes):
    """Clips of still pictures in motion, made while training runs.

    Besides its own arguments it has those of :class:`StillClips` that say how a clip is made.

    Args:
        root: folder of training pictures, read with all folders in it. Without it, the photographs inside
            scikit-image's wheel and procedural textures: no files are needed.
        val_root: folder of validation pictures. Without it, one picture in twenty of ``root`` is kept for validation
            (at least four, if there are as many again); without both, four held-out photographs of scikit-image.
        patch: side of a training clip in sensor pixels.
        val_patch: side of a validation or test clip in sensor pixels.
        flow_patch: smallest side, in sensor pixels, of the part of a scene that motion is estimated on in training: on
            less the estimate is poor. Spikes of training clips reach so far beyond their patch. ``lightning`` says 48
            where ``model.flow`` is estimated, else 0.
        cache: folder where training clips are kept, for trials of a sweep that train on the same ones. It is never
            emptied: delete it, or files in it, at any time. Null for none.
        train_clips: training clips in an epoch. They are new in every epoch.
        val_clips: validation clips, the same every time; also those of ``test``.
        batch_size: clips in a batch.
        workers: processes that make clips. Null takes one less than there are cores, sixteen at most: one core is left
            to training.
        seed: where chance begins. The same seed gives the same clips, whatever the number of workers.
    """

    @takes(StillClips, "pictures", "augment", "textures", "length")
    def __init__(
        self,
        root: str | None = None,
        val_root: str | None = None,
        *,
        patch: int = 96,
        val_patch: int = 96,
        flow_patch: int = 0,
        cache: str | None = None,
        train_clips: int = 1200,
        val_clips: int = 16,
        batch_size: int = 4,
        workers: int | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(batch_size, batch_size, workers)
        self.root, self.val_root = root, val_root
        self.patch, self.val_patch, self.flow_patch, self.cache = patch, val_patch, flow_patch, cache
        self.train_clips, self.val_clips, self.seed = train_clips, val_clips, seed
        self.options = {**options, "seed": seed}

    def setup(self, stage: str | None = None) -> None:
        """Find the pictures.

        Raises:
            FileNotFoundError: a folder is missing or holds no picture.
            OSError: the cache cannot be made.
            ValueError: an argument that makes no sense.
        """
        if self.batch_size < 1 or self.train_clips < self.batch_size:
            raise ValueError(f"train_clips: expected at least batch_size = {self.batch_size}, got {self.train_clips}")
        train, val = self._pictures()
        train_only = {"textures": self.root is None, "flow_patch": self.flow_patch}
        train_only["cache"] = ClipCache(self.cache) if self.cache else None
        self.train_set = StillClips(train, **self.options, patch=self.patch, length=self.train_clips, **train_only)
        self.val_set = StillClips(val, **self.options, patch=self.val_patch, length=self.val_clips, augment=False)
        self.test_set = self.val_set

    def _pictures(self) -> tuple[list[Path], list[Path]]:
        if self.root is None:
            train, val = embedded_pictures(), embedded_pictures(held_out=True)
        elif self.val_root is None:
            return split_pictures(folder_pictures(self.root), self.seed)
        else:
            train, val = folder_pictures(self.root), []
        return train, val if self.val_root is None else folder_pictures(self.val_root)
