"""The constants of a network's error model, fitted on scenes whose truth is known, and what they lose on others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from math import log10
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.inference.scene_activity import CELL, Activity, expected_errors, moving_cells, scene_activity
from lightning_modules.networks import Network
from lightning_modules.storage.error_model import ErrorModel
from spikekit import read_picture
from spikekit.scenes.analytic import Layer, Motion, Scene
from spikekit.sensor.simulate import simulate_spikes

#: scenes by name: velocity of the background, in sensor pixels per clock, and whether an object moves before it
SCENES = {"still": (0.0, False), "slow": (0.1, False), "mixed": (0.0, True), "fast": (0.4, False)}
#: tolerances that the constants hold for, in dB
TOLERANCES = (0.1, 0.5)

_SIZE = 96, 128  # sensor pixels of a clip
_OBJECT = 24  # of the object that moves
_SHARE = 0.9  # weight of errors that are expected too small, against those expected too large
_MARGIN = 0.4  # of a tolerance that the worst of the fitted clips may lose; others lose more
_STEP = 1.15  # factor by which the cost of less work is raised until they do


@dataclass(frozen=True)
class Clip:
    """A clip whose truth is known.

    Args:
        picture: name of the picture that it shows.
        scene: name of the scene, one of ``SCENES``.
        spikes: (1, N, H, W).
        truth: rgb (3, s H, s W).
    """

    picture: str
    scene: str
    spikes: Tensor
    truth: Tensor


@dataclass(frozen=True)
class Errors:
    """Errors of a network on a clip, cell by cell.

    Args:
        clip: name of its picture and scene.
        seen: statistics of the clip.
        still: squared errors of the network that is told that nothing moves, by sensor pixel, (h, w), float64.
        own: likewise, of the network with its own estimate of motion.
    """

    clip: str
    seen: Activity
    still: Tensor
    own: Tensor


def make_clips(
    pictures: Sequence[Path], count: int, scale: int, pattern: str, alpha: float, frames: int
) -> Iterator[Clip]:
    """Make clips of pictures, which take turns, and so do the scenes.

    Args:
        pictures: their middles are seen.
        count: how many clips; the same scene comes again with another picture.
        scale: how many pixels of a picture a sensor pixel is wide.
        pattern: Bayer phase.
        alpha: light of a white pixel per clock, in thresholds.
        frames: clocks of a clip.
    """
    height, width = (scale * side for side in _SIZE)
    for n in range(count):
        # another picture every time, and another scene when all pictures had their turn
        place = n % len(pictures)
        name = list(SCENES)[(n + n // len(pictures)) % len(SCENES)]
        speed, moving = SCENES[name]
        ground = _middle(read_picture(pictures[place]), height, width)
        layers = [Layer(ground, Motion(velocity=(speed * scale, speed * scale / 2)))]
        if moving:
            side = scale * _OBJECT
            thing = _middle(read_picture(pictures[(place + 1) % len(pictures)]), side, side)
            y, x = (torch.linspace(-1, 1, length) for length in thing.shape[1:])
            disc = (y[:, None].square() + x.square() <= 1).to(thing)
            layers.append(Layer(thing, Motion(velocity=(0.2 * scale, 0.1 * scale)), (width // 3, height // 3), disc))
        scene = Scene(layers, height, width, frames)
        light = scene.light(pattern, scale=scale, alpha=alpha)
        spikes = simulate_spikes(light, generator=torch.Generator().manual_seed(n))[None]
        yield Clip(pictures[place].stem, name, spikes, scene.rgb(scene.middle))


def _middle(picture: Tensor, height: int, width: int) -> Tensor:
    top, left = max(0, (picture.shape[1] - height) // 2), max(0, (picture.shape[2] - width) // 2)
    return picture[:, top : top + height, left : left + width]


@torch.no_grad()
def measure_errors(network: Network, clip: Clip, flow: Tensor | None = None) -> Errors:
    """Run a network on a clip with and without motion, and compare everything with the truth.

    Args:
        network: the network.
        clip: made for its scale, pattern, gain and number of frames.
        flow: its estimate of motion, where it is known already.
    """
    alpha = network.settings["alpha"]
    still, own = network(clip.spikes, static=True), network(clip.spikes, flow)
    errors = (_cells((rgb[0].clamp(0, 1) - clip.truth).square(), network.scale) for rgb in (still, own))
    name = f"{clip.picture}, {clip.scene}"
    return Errors(name, scene_activity(clip.spikes, network.pattern, alpha), *errors)


def _cells(error: Tensor, scale: int) -> Tensor:
    of_sensor = F.avg_pool2d(error.mean(dim=0)[None, None].double(), scale)
    return F.avg_pool2d(of_sensor, CELL, ceil_mode=True, divisor_override=1)[0, 0]


def loss(errors: Errors, model: ErrorModel, tolerance: float) -> tuple[float, float]:
    """Return the loss of a clip by a tolerance where every cell gets just what it is said to need.

    Tiles give a cell as much or more.

    Args:
        errors: of the clip.
        model: constants that say what is needed.
        tolerance: in dB.

    Returns:
        The fall of the PSNR in dB, and the share of the cells that get motion.
    """
    motion = moving_cells(*expected_errors(errors.seen, model), tolerance)
    left = torch.where(motion, errors.own, errors.still).sum()
    return 10 * log10(left / errors.own.sum()), motion.double().mean().item()


def fit_error_model(clips: Sequence[Errors]) -> ErrorModel:
    """Fit constants, to the side that spends more.

    What less work adds, and what the network leaves itself, are non-negative combinations of the statistics, by least
    squares, relative to the network's own error in every cell; where they expect too little to be added, or too much to
    be left, the square weighs nine times as much. What is added is then scaled until no clip loses more than four
    tenths of any of ``TOLERANCES``.

    Args:
        clips: errors of a network, of clips with and without motion.

    Raises:
        ValueError: no constants hold the tolerances on these clips.
    """
    texture, change, area = (
        _stack([part[0] for part in parts]) for parts in zip(*(clip.seen for clip in clips), strict=True)
    )
    still, own = (_stack([getattr(clip, name) for clip in clips]) for name in ("still", "own"))
    relative = 1 / (own + 1e-5 * area)
    left = _envelope([texture, change, area], own, relative, 1 - _SHARE)
    stilled = _envelope([change], still - own, relative, _SHARE)
    model = ErrorModel(*map(float, (*stilled, *left)))
    for factor in _STEP ** np.arange(50.0):
        careful = _scaled(model, factor)
        if all(loss(clip, careful, value)[0] <= _MARGIN * value for clip in clips for value in TOLERANCES):
            return careful
    raise ValueError("clips: expected some on which less work costs what texture and change let expect")


def _scaled(model: ErrorModel, factor: float) -> ErrorModel:
    """Constants of three digits, what is added times a factor."""
    scaled = replace(model, still=model.still * factor)
    return ErrorModel(**{name: float(f"{value:.3g}") for name, value in asdict(scaled).items()})


def _stack(parts: Sequence[Tensor]) -> np.ndarray:
    return torch.cat([part.flatten() for part in parts]).double().numpy()


def _envelope(statistics: Sequence[np.ndarray], target: np.ndarray, relative: np.ndarray, share: float) -> np.ndarray:
    """Non-negative factors by asymmetric least squares: a share of the weight is on targets above the combination."""
    from scipy.optimize import nnls

    columns, target, weight = np.stack(statistics, axis=1) * relative[:, None], target * relative, np.ones(len(target))
    for _ in range(30):
        factors, _ = nnls(columns * np.sqrt(weight)[:, None], target * np.sqrt(weight))
        weight = np.where(target > columns @ factors, share, 1 - share)
    return factors
