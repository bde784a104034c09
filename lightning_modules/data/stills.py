"""Clips from still pictures in motion, with exact ground truth and flow, for training and validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from lightning_modules.data.cache import ClipCache, clip_key, file_digest, unpack_clip
from lightning_modules.data.loading import ClipScenes, cut_key_frames, flow_margin, trim
from lightning_modules.data.pictures import embedded_pictures, folder_pictures, split_pictures
from lightning_modules.data.pool import ScenePool
from lightning_modules.data.rendering import Gallery, Pictures, draw_cut, render_scene, see
from lightning_modules.data.textures import outline
from lightning_modules.signatures import inherit_signature
from spikekit import fill_defects
from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import cfa_pattern
from spikekit.scenes import analytic
from spikekit.scenes.analytic import Scene
from spikekit.scenes.frame_sequence import SIMULATOR_VERSION
from spikekit.sensor.noise import SensorNoise

#: files whose code determines how a clip looks, besides the sensor
_CODE = [Path(__file__).with_name(f"{name}.py") for name in ("stills", "rendering", "textures", "pictures")] + [
    Path(analytic.__file__)
]
_TEXTURES = 0.3  # fraction of procedural textures among the pictures
_ANGLES = 256  # samples of an outline
_MOVES = "motion", "bend", "rotation", "zoom"


@dataclass(eq=False, repr=False)
class StillClips(Dataset):
    """Clips of random scenes; seed and index determine a clip, in any process and order.

    Args:
        pictures: picture files for the scenes.
        scale: super-resolution factor: width of a sensor pixel in pixels of the view.
        patch: side of the clip in sensor pixels.
        frames: spike frames of a clip. The ground truth is the view at spike frame ``frames // 2``.
        pattern: Bayer phase of the sensor, RGGB, BGGR, GRBG or GBRG; or grey, with a ground truth of one channel.
        alpha: light of a white pixel per clock; the threshold of charge is 1.
        motion: largest displacement of the centre of the background from the middle frame to the first or last one, in
            sensor pixels. Objects move by up to as much relative to the background.
        bend: largest additional displacement by acceleration, in sensor pixels, for the background and each object;
            paths are then parabolas.
        rotation: largest rotation of the background and each object in that time, in degrees.
        zoom: largest magnification or reduction of the background and each object in that time; 0.01 is one per cent.
        objects: largest number of objects in front of the background.
        brightness: lowest and highest exposure; a random number in between multiplies ground truth and light of a clip.
        noise: noise of the sensor, such as ``{photons: 3000, gain_spread: 0.06}``. With ``augment``, as in training,
            every clip has a random share of it, given as its ``noise``, and a third have none, so that a network learns
            ideal sensors and all levels of noise. Dead and hot pixels are filled, see :func:`spikekit.fill_defects`.
        gains: lowest and highest alpha with ``augment``, drawn log-uniformly and given as the clip's ``alpha``. Null
            for a constant alpha.
        flow_times: spike frames to which the flow from the middle frame is given; for 41 frames and a window of 11, 5
            and 35 are the centres of the first and last window.
        key_frames: consecutive clips of a scene, for networks for films.
        every: spike frames between the middles of consecutive clips.
        seed: random seed.
        augment: mirror, rotate and recolour the pictures. Otherwise, the index selects the picture of the background.
        textures: also use procedural pictures, see :func:`lightning_modules.data.textures.texture`.
        length: value of ``len``; every index from 0 on is valid.
        flow_patch: smallest side of the spikes, in sensor pixels, for the estimate of motion. Spikes reach beyond the
            patch accordingly; ground truth and flow cover the patch.
        cache: cache of the clips; ``None`` to make them every time.

    Raises:
        ValueError: an argument is out of range; the message names it.
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
        self.flow_times, self.margin = tuple(self.flow_times), flow_margin(self.patch, self.flow_patch)
        _check(self)
        self.gains = self.gains and tuple(self.gains)
        self.sources = Pictures(self.pictures, self.textures)
        self.clocks = self.frames + (self.key_frames - 1) * self.every
        #: side of the view in its pixels, and margin around it that motion, rotation and zoom can bring into view
        self.side = self.scale * (self.patch + 2 * self.margin)
        # half length of a film, relative to that of a clip
        longer = (self.clocks // 2) / max(self.frames // 2, 1) if self.key_frames > 1 else 1
        turns = (self.side - 1) / 2 * math.sqrt(2) * (math.radians(self.rotation) + self.zoom)
        reach = turns * longer + (self.motion * longer + self.bend * longer**2) * self.scale
        self.around = math.ceil(reach) + 2

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """Return a clip: ``spikes`` uint8 (N, H, W), ``rgb`` (3, s h, s w) and ``flow`` (times, 2, h, w) float32.

        (h, w) is the size of the patch; (H, W) is larger only with ``flow_patch``. With K key frames, ``spikes`` is
        (K, N, H, W), ``rgb`` (K, 3, s h, s w), and ``every`` replaces the flow. With ``gains``, the clip has its
        ``alpha``; with ``noise``, its level of ``noise``.
        """
        if self.cache is None:
            return self.cut(self.whole(index))
        packed = self.cache.packed(clip_key(source=self._source, index=index), lambda: self.whole(index))
        side, drawn = self.patch + 2 * self.margin, self._sensor(index) if self._told else {}
        told = {name: torch.tensor(drawn[name]) for name in self._told}
        return self.cut(unpack_clip(packed, (0, 0, side, side), self.scale) | told)

    @cached_property
    def _source(self) -> str:
        """Digest of everything that determines a clip, except its index."""
        aside = {"pictures", "sources", "length", "cache"}
        options = {name: value for name, value in vars(self).items() if name not in aside}
        options["noise"] = self.noise and asdict(self.noise)
        files = [file_digest(path) for path in (*_CODE, *self.pictures)]
        return clip_key(simulator=SIMULATOR_VERSION, files=files, **options)

    def whole(self, index: int) -> dict[str, Tensor]:
        """Return a clip with the ``spikes`` of all key frames, (T, H, W), before they are cut into clips."""
        drawn, gallery = self._alone(index)
        return {name: part[0] for name, part in self.render(drawn, gallery).items()}

    def _alone(self, index: int) -> tuple[dict[str, np.ndarray], Gallery]:
        """Return the random numbers of a scene, as a batch of one, and its pictures."""
        drawn = {name: part[None] for name, part in self.draw(index).items()}
        used, drawn["picture"] = np.unique(drawn["picture"], return_inverse=True)
        drawn["picture"] = drawn["picture"].reshape(1, -1)
        return drawn, Gallery.of([self.sources[n] for n in used])

    def render(self, drawn: dict[str, np.ndarray], gallery: Gallery) -> dict[str, Tensor]:
        """Render clips from random numbers of :meth:`draw`, with a leading dimension B, before :meth:`cut`."""
        scene = self._scene(drawn, gallery)
        light = scene.light(self.pattern, scale=self.scale, alpha=1.0)
        middles = [self.frames // 2 + n * self.every for n in range(self.key_frames)]
        rgb = torch.stack([trim(scene.rgb(middle), self.scale * self.margin) for middle in middles], dim=1)
        spikes = see(light, drawn, self.noise)
        spikes = fill_defects(spikes, self.pattern) if self.noise else spikes  # as is done with recordings
        clips = {"spikes": spikes, "rgb": rgb if self.key_frames > 1 else rgb[:, 0]}
        if self.key_frames == 1:
            flow = torch.stack([scene.flow(clock, scale=self.scale) for clock in self.flow_times], dim=1)
            clips["flow"] = trim(flow, self.margin)
        return clips | {name: torch.from_numpy(drawn[name]).to(rgb.device) for name in self._told}

    @property
    def _told(self) -> list[str]:
        """Names of the camera parameters that a clip includes."""
        return [name for name, varies in (("alpha", self.gains), ("noise", self.noise)) if varies]

    def cut(self, clip: dict[str, Tensor]) -> dict[str, Tensor]:
        """Cut a result of :meth:`whole` or :meth:`render` into one clip per key frame."""
        return cut_key_frames(clip, self.key_frames, self.frames, self.every)

    def scene(self, index: int) -> Scene:
        """Return the scene of a clip, to render it at other times or sizes."""
        scene = self._scene(*self._alone(index))
        alone = [
            replace(layer, picture=layer.picture[0], mask=None if layer.mask is None else layer.mask[0])
            for layer in scene.layers
        ]
        return Scene(alone, scene.height, scene.width, scene.frames)

    def _scene(self, drawn: dict[str, np.ndarray], gallery: Gallery) -> Scene:
        return render_scene(drawn, gallery, self.pattern, self.side, self.around, self.clocks)

    def draw(self, index: int) -> dict[str, np.ndarray]:
        """Draw the random numbers of a scene, for its background and objects; :meth:`render` makes a clip of them."""
        rng, side, half = self._rng(index, "scene"), self.side, max(self.frames // 2, 1)
        middle = (side - 1) / 2
        brightness = rng.uniform(*self.brightness)
        velocity = _in_disc(rng) * self.motion * self.scale / half
        around = side + 2 * self.around
        layers = [self._layer(around, (-self.around, -self.around), velocity, (middle, middle), rng, index)]
        for n in range(rng.integers(self.objects + 1)):
            size = max(4, round(side * rng.uniform(0.15, 0.5)))
            corner = rng.integers(-size // 2, side - size // 2, 2)
            moves = velocity + _in_disc(rng) * self.motion * self.scale / half
            layers.append(self._layer(size, corner, moves, corner + (size - 1) / 2, rng))
            radius = outline(np.linspace(-np.pi, np.pi, _ANGLES, endpoint=False), rng)
            layers[n + 1]["outline"] = (radius / radius.max()).astype("float32")
        # padded with empty layers, so that all scenes of a batch have the same number
        layers += [_NONE] * (1 + self.objects - len(layers))
        drawn = {name: np.stack([layer[name] for layer in layers]) for name in layers[0]}
        drawn["outline"] = np.stack([layer["outline"] for layer in layers[1:]]) if self.objects else np.zeros((0, 0))
        return drawn | {"brightness": np.float32(brightness)} | self._sensor(index)

    def _layer(
        self, side: int, corner: Any, velocity: Any, center: Any, rng: np.random.Generator, turn: int | None = None
    ) -> dict[str, Any]:
        """Draw a random square of a moving picture; ``turn`` selects the picture of backgrounds without ``augment``."""
        half, count = max(self.frames // 2, 1), len(self.pictures)
        if self.textures and rng.uniform() < _TEXTURES:
            which = count + int(rng.integers(self.sources.textures))
        else:
            which = int(rng.integers(count)) if self.augment or turn is None else turn % count
        push = _in_disc(rng) * 2 * self.bend * self.scale / half**2
        # at scale 1 no later averaging sharpens edges
        least = 0.25 if self.scale == 1 else 0.5
        return {
            "picture": which,
            "side": side,
            "cut": draw_cut(side, self.sources.size(which), rng, mirror=1.25 if self.augment else 1.0, least=least),
            **(_recolour(rng) if self.augment else _AS_IT_IS),
            "position": np.array(corner, "float64"),
            "velocity": velocity,
            "center": np.array(center, "float64"),
            "rotation": math.radians(self.rotation * rng.uniform(-1, 1)) / half,
            "zoom": (1 + self.zoom) ** (rng.uniform(-1, 1) / half),
            "acceleration": push,
        }

    def _sensor(self, index: int) -> dict[str, np.ndarray]:
        """Draw the random numbers of the sensor."""
        rng, side = self._rng(index, "spikes"), self.patch + 2 * self.margin
        drawn = {"charge": rng.random((side, side), "float32"), "alpha": np.float32(self.alpha)}
        if self.gains and self.augment:
            drawn["alpha"] = np.float32(np.exp(rng.uniform(*np.log(self.gains))))
        if self.noise is None:
            return drawn
        drawn["photons"], drawn["electrons"] = rng.integers(2**62, size=2)
        drawn["noise"] = np.float32(max(0.0, 1.5 * rng.uniform() - 0.5) if self.augment else 1)
        for name, wanted in (("gain", self.noise.gain_spread), ("dark", self.noise.dark_current)):
            if wanted:
                drawn[name] = rng.standard_normal((side, side), "float32")
        if self.noise.hot or self.noise.dead:
            drawn["defects"] = rng.random((side, side), "float32")
        return drawn

    def _rng(self, index: int, purpose: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.augment, index, purpose == "spikes"])


#: parameters of an unchanged picture
_AS_IT_IS = {
    "turn": np.zeros(3, bool),
    "colours": np.arange(3),
    "tint": np.repeat(np.float32([[0], [1]]), 3, axis=1),
}
_NONE = {
    "picture": 0,
    "side": 0,
    "cut": np.ones((2, 4), "int32"),
    **_AS_IT_IS,
    **dict.fromkeys(("position", "velocity", "center", "acceleration"), np.zeros(2)),
    "rotation": 0.0,
    "zoom": 1.0,
    "outline": np.zeros(_ANGLES, "float32"),
}


def _check(clips: StillClips) -> None:
    for name in ("scale", "patch", "frames", "key_frames", "every", "length"):
        setattr(clips, name, check_whole(name, getattr(clips, name)))
    check_positive("alpha", clips.alpha)
    clips.pattern = cfa_pattern(clips.pattern)
    at_least_0 = {name: 0 <= getattr(clips, name) < math.inf for name in (*_MOVES, "objects", "seed")}
    (low, high), gains = clips.brightness, clips.gains
    for name, good, expected in (
        *((name, good, "0 or more") for name, good in at_least_0.items()),
        ("pictures", len(clips.pictures) > 0, "at least one"),
        ("brightness", 0 <= low <= high < math.inf, "two numbers 0 <= low <= high"),
        ("flow_times", all(0 <= t < clips.frames for t in clips.flow_times), f"clocks in [0, {clips.frames})"),
        ("gains", gains is None or 0 < gains[0] <= gains[1] < math.inf, "two numbers 0 < low <= high, or null"),
        ("noise", getattr(clips.noise, "calibration", None) is None, "no calibration, as it has a fixed size"),
    ):
        if not good:
            raise ValueError(f"{name}: expected {expected}, got {getattr(clips, name)}")


def _in_disc(rng: np.random.Generator) -> np.ndarray:
    """Draw (x, y) in the unit disc, with uniform direction and uniform length."""
    angle, length = rng.uniform(0, 2 * math.pi), rng.uniform()
    return length * np.array([math.cos(angle), math.sin(angle)])


def _recolour(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw mirroring, transposition, rare swaps of colours, and a tint for grey pictures."""
    dark, bright = np.sort(rng.uniform(0, 1, (2, 3)) ** [[2.0], [0.5]], axis=0)
    changed = {"turn": rng.uniform(size=3) < 0.5}
    changed["colours"] = rng.permutation(3) if rng.uniform() < 0.1 else _AS_IT_IS["colours"]
    tint = rng.uniform() < 0.5
    return changed | {"tint": np.stack([dark, bright]).astype("float32") if tint else _AS_IT_IS["tint"]}


class StillScenes(ClipScenes):
    """Clips of still pictures in motion, made during training.

    Arguments of :class:`StillClips` that describe a clip are accepted as well.

    Args:
        root: folder of training pictures, with subfolders. Default: photographs of scikit-image and procedural
            textures, without any files.
        val_root: folder of validation pictures. Default: one picture in twenty of ``root``, but at least four, or half
            if there are fewer than eight; without ``root``, four held-out photographs of scikit-image.
        patch: side of a training clip in sensor pixels.
        val_patch: side of a validation or test clip in sensor pixels.
        flow_patch: smallest side, in sensor pixels, for the estimate of motion in training, as small patches give poor
            estimates. Spikes of training clips reach beyond their patch accordingly. ``lightning`` sets 48 if
            ``model.flow`` is estimated, else 0.
        cache: folder of training clips, for trials of a sweep that train on the same clips. It is never emptied; files
            can be deleted at any time. Null for none.
        train_clips: training clips in an epoch; they are new in every epoch.
        val_clips: validation clips, always the same; also used by ``test``.
        batch_size: clips in a batch.
        pool: training clips that are rendered at once on the training device, from random numbers of the workers; about
            1000 pay off on a GPU. 0 to render in the workers.
        reuse: number of times that a clip of a pool is used, each time transformed.
        kinds: kinds of scenes in a pool, such as ``[{share: 0.4}, {share: 0.6, key_frames: 5, every: 8}]``: the share
            of the batches, and arguments that override the others. Null for one kind.
        workers: processes that make clips. Null for all cores but one, at most sixteen.
        seed: random seed; the clips do not depend on the number of workers.
    """

    @inherit_signature(StillClips, "pictures", "augment", "textures", "length")
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
        pool: int = 0,
        reuse: int = 4,
        kinds: list[dict[str, Any]] | None = None,
        workers: int | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(batch_size, batch_size, workers)
        self.root, self.val_root = root, val_root
        self.patch, self.val_patch, self.flow_patch, self.cache = patch, val_patch, flow_patch, cache
        self.train_clips, self.val_clips, self.seed = train_clips, val_clips, seed
        self.pool, self.reuse, self.kinds = pool, reuse, kinds
        self.options = {**options, "seed": seed}

    def setup(self, stage: str | None = None) -> None:
        """Find the pictures.

        Raises:
            FileNotFoundError: a folder does not exist or has no pictures.
            OSError: the cache folder cannot be made.
            ValueError: an argument is out of range.
        """
        for name in ("batch_size", "val_clips"):
            check_whole(name, getattr(self, name))
        if self.train_clips < self.batch_size:
            raise ValueError(f"train_clips: expected at least batch_size = {self.batch_size}, got {self.train_clips}")
        for name, good, expected in (
            ("pool", self.pool >= 0, "0 or more clips"),
            ("reuse", self.reuse >= 1, "at least 1"),
            ("kinds", self.pool or not self.kinds, "a pool of more than 0 clips with them"),
            ("cache", not (self.pool and self.cache), "none with a pool"),
        ):
            if not good:
                raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)}")
        train, val = self._pictures()
        train_only = {"textures": self.root is None, "flow_patch": self.flow_patch}
        train_only["cache"] = ClipCache(self.cache) if self.cache else None
        train_only |= {"patch": self.patch, "length": self.train_clips}
        self.train_set = StillClips(train, **self.options, **train_only)
        self._shares, self._kinds = [1.0], [self.train_set]
        if self.kinds:
            self._shares = [kind.get("share", 1.0) for kind in self.kinds]
            own = [{name: value for name, value in kind.items() if name != "share"} for kind in self.kinds]
            try:
                self._kinds = [StillClips(train, **{**self.options, **train_only, **options}) for options in own]
            except TypeError as error:
                raise ValueError(f"kinds: expected arguments of StillClips and share, got {self.kinds}") from error
        self.val_set = StillClips(val, **self.options, patch=self.val_patch, length=self.val_clips, augment=False)
        self.test_set = self.val_set

    def train_dataloader(self) -> Any:  # noqa: D102
        if not self.pool:
            return super().train_dataloader()
        how = {"size": self.pool, "reuse": self.reuse, "batch_size": self.batch_size, "workers": self.workers}
        return ScenePool(self, self._kinds, self._shares, length=self.train_clips // self.batch_size, **how)

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:  # noqa: D102
        if self.pool and self.trainer.training:
            return batch  # already there
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def _pictures(self) -> tuple[list[Path], list[Path]]:
        if self.root is None:
            train, val = embedded_pictures(), embedded_pictures(held_out=True)
        elif self.val_root is None:
            return split_pictures(folder_pictures(self.root), self.seed)
        else:
            train, val = folder_pictures(self.root), []
        return train, val if self.val_root is None else folder_pictures(self.val_root)
