"""Presets of weights and settings, and the choice of one by speed or budget."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import torch

from lightning_modules.inference.clips import FRAMES
from lightning_modules.inference.predict import precision_of, predict
from lightning_modules.inference.tiles import FAR, TILE
from lightning_modules.networks import CSCSR, ClassicalDecoder, Network
from lightning_modules.registry import find_model, for_noise
from spikekit.timing import timer_of

_FOLDER = Path(__file__).parents[1] / "weights"

_DECODER = "ClassicalDecoder"

#: largest loss against the best preset, in dB
SPEEDS = {"fastest": float("inf"), "fast": 2.7, "balanced": 0.3, "best": 0.005}

#: presets whose times differ by less than this factor count as equally fast
_AS_FAST = 1.2

#: MiB per sensor pixel for the estimate of motion, which covers the whole frame (measured with ClassicalFlow)
_MOTION = 240 / 2**20

_UNITS = {"ms": ("ms", 1.0), "s": ("ms", 1e3), "MiB": ("mib", 1.0), "GiB": ("mib", 1024.0)}
_UNITS |= {"MB": ("mib", 1e6 / 2**20), "GB": ("mib", 1e9 / 2**20)}


@dataclass(frozen=True)
class Preset:
    """A network and its settings; ``None`` stands for the default.

    Args:
        weights: name of weights of the package, or path of a weights file.
        network: ``"ClassicalDecoder"``, in place of ``weights``.
        method: ``"tfi"`` or ``"tfp"``; for the decoder only.
        window: window of the decoder.
        order: order of the decoder.
        scale: super-resolution factor of the decoder; weights have their own.
        frames: spike frames of a clip of the decoder; weights have their own.
        tile: side of a tile in sensor pixels, see :func:`lightning_modules.inference.predict.predict`.
        self_ensemble: number of views, 1, 2, 4 or 8, see :func:`lightning_modules.inference.predict.predict`.
        precision: precision of the Trainer, such as ``"bf16-mixed"``.

    Example:
        >>> Preset("cscsr_small_x4").build().scale
        4
    """

    weights: str | None = None
    network: str | None = None
    method: str | None = None
    window: int | None = None
    order: int | None = None
    scale: int | None = None
    frames: int | None = None
    tile: int | None = None
    self_ensemble: int | None = None
    precision: str | None = None

    def given(self, *names: str) -> dict[str, Any]:
        """Return the named arguments that are not ``None``."""
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def clip(self) -> int:
        """Spike frames of a clip; 41 is assumed for weights from outside the package."""
        model = find_model(self.weights or "")
        return (model and model.frames) or self.frames or FRAMES

    @property
    def moves(self) -> bool:
        """Whether motion is estimated; assumed for weights from outside the package."""
        model = find_model(self.weights or "")
        return self.weights is not None and (model is None or model.search)

    @classmethod
    def read(cls, row: Mapping[str, str]) -> Preset:
        """Return the preset in a row of a table; an empty cell is ``None``.

        Example:
            >>> Preset.read({"weights": "cscsr_small_x4", "tile": "64", "self_ensemble": ""})
            Preset(weights='cscsr_small_x4', ..., tile=64, self_ensemble=None, ...)
        """
        kinds = {one.name: int if one.type == "int | None" else str for one in fields(cls)}
        return cls(**{name: kind(row[name]) for name, kind in kinds.items() if row.get(name)})

    def build(self, pattern: str = "RGGB") -> Network:
        """Build the network in evaluation mode, on the CPU.

        ``pattern`` is the Bayer phase of a decoder, or ``"grey"``; weights have their own. ``tile``, ``self_ensemble``
        and ``precision`` have no effect here: pass them to :func:`lightning_modules.inference.predict.predict` and to
        the Trainer.
        """
        if self.network == _DECODER:
            options = self.given("method", "window", "order", "scale", "frames")
            return ClassicalDecoder(**options, pattern=pattern).eval()
        if self.weights is None or self.network is not None:
            raise ValueError(f"preset: expected weights, or {_DECODER} as network, got {self}")
        return CSCSR.from_pretrained(self.weights)


@dataclass(frozen=True)
class Conditions:
    """What is to be reconstructed; the choice of a preset depends on it.

    Args:
        scale: super-resolution factor.
        size: size of a frame, (H, W) in sensor pixels.
        film: use the table of films (``lightning trade --film``), if the package has one for the scale.
        frames: spike frames available for a clip; presets that need more are left out. From 101 on, presets with longer
            clips take part.
        noisy: of the networks keep only those with weights trained for noisy sensors, and use these weights.
        grey: use the table of grey cameras, if the package has one for the scale.
    """

    scale: int
    size: tuple[int, int] = (250, 400)
    film: bool = False
    frames: int = FRAMES
    noisy: bool = False
    grey: bool = False


@dataclass(frozen=True)
class Choice:
    """A measured preset and its expected cost: PSNR, difference to the best, time and memory of a frame."""

    name: str
    preset: Preset
    psnr: float  # in dB, on the clips of the table
    below: float  # in dB
    ms: float
    mib: float
    where: str = "on the reference machine"

    def __str__(self) -> str:
        time = f"{self.ms:.3g} ms" if self.ms < 1e3 else f"{self.ms / 1e3:.3g} s"
        memory = f"{self.mib:.3g} MiB" if self.mib < 1e3 else f"{self.mib / 1024:.3g} GiB"
        cost = f"about {time} and {memory} per picture {self.where}"
        return f"{self.name}: {cost}, {self.below:.2f} dB below the best"


def choices(conditions: Conditions) -> list[Choice]:
    """Return the measured presets for a scale that keep the default precision, fastest first.

    The expected time grows with the number of pixels: the ratio in the table times the time of the table's reference
    row. The expected memory grows with the number of pixels until a tile and the reach of motion around it are full.
    Beyond that, only the part that covers the whole frame grows: the picture and the estimate of motion. Presets
    without tiles are left out, as their memory has no bound.
    """
    rows = _table(conditions)
    twins = for_noise(conditions.scale) if conditions.noisy else {}
    frame = min(float(row["mib"]) for row in rows)
    found = []
    for row in rows:
        preset = Preset.read(row)
        if preset.precision is not None or preset.tile == 0 or not (preset.weights or preset.network):
            continue
        if preset.clip > conditions.frames or (conditions.noisy and preset.weights not in {*twins, None}):
            continue
        preset = replace(preset, weights=twins.get(preset.weights, preset.weights))
        measured = int(row["height"]) * int(row["width"])
        pixels = prod(conditions.size) / measured
        model = find_model(preset.weights or "")
        margin = model.margin if model else CSCSR.halo
        in_tile = min(pixels, ((preset.tile or TILE) + 2 * (margin + FAR)) ** 2 / measured)
        psnr, ratio, mib = (float(row[name]) for name in ("psnr", "ratio", "mib"))
        everywhere = frame + preset.moves * _MOTION * measured
        mib = everywhere * pixels + (mib - everywhere) * in_tile
        ms = ratio * float(_reference(rows)["ms"]) * pixels
        name = row["setting"].replace(row["weights"], preset.weights) if preset.weights else row["setting"]
        found.append(Choice(name, preset, psnr, 0.0, ms, mib))
    if not found:
        raise ValueError(f"{_FOLDER / f'x{conditions.scale}.csv'}: expected presets with tiles, got none")
    best = max(choice.psnr for choice in found)
    found = [replace(choice, below=best - choice.psnr) for choice in found]
    return sorted(found, key=lambda choice: choice.ms)


def _table(conditions: Conditions) -> list[dict[str, str]]:
    scale, asked = conditions.scale, (("_grey", conditions.grey), ("_film", conditions.film))
    kinds = product(*([name, ""] if holds else [""] for name, holds in asked))  # the best match first
    paths = (_FOLDER / f"x{scale}{''.join(kind)}.csv" for kind in kinds)
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        there = ", ".join(sorted(path.stem for path in _FOLDER.glob("x?.csv"))) or "none"
        raise ValueError(f"scale: expected one that was measured ({there}), got {scale}")
    with open(path, newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if not row["failed"]]


def _reference(rows: list[dict[str, str]]) -> dict[str, str]:
    """Return the row that all ratios refer to."""
    return next(row for row in rows if row["setting"] == row["reference"])


def pace(conditions: Conditions) -> float:
    """Measure the time of a frame, relative to the table, with the reference preset on a quarter of a clip's area."""
    row = _reference(_table(conditions))
    preset = Preset.read(row)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = preset.build().to(device)
    options = preset.given("tile", "self_ensemble")
    height, width = int(row["height"]) // 2, int(row["width"]) // 2
    spikes = torch.rand(1, network.frames, height, width, device=device) < network.settings["alpha"] / 2
    timer, _ = timer_of(device, torch.get_num_threads())
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=precision_of(device) != "32-true"):
        predict(network, spikes, **options)
        return 4e3 * timer(lambda: predict(network, spikes, **options), 3) / float(row["ms"])


def choose(conditions: Conditions, speed: str | None = None, budget: str | None = None) -> Choice:
    """Choose the best preset for a speed or a budget.

    A time budget first measures this machine (:func:`pace`), which takes about a second.

    Args:
        conditions: what is to be reconstructed; a budget depends on the size of its frames.
        speed: ``"best"``, ``"balanced"``, ``"fast"`` or ``"fastest"``: the fastest preset within the loss of
            :data:`SPEEDS`. Of presets that are about as fast, the one with the highest PSNR.
        budget: in place of ``speed``, the largest time or memory per frame, such as ``"40ms"``, ``"25fps"`` or
            ``"200MB"``. The preset with the highest PSNR that fits is chosen.

    Raises:
        ValueError: the speed is unknown, the budget cannot be read, no preset fits it, or the package has no table for
            the scale.

    Example:
        >>> choose(Conditions(4), "fastest").ms <= choose(Conditions(4), "best").ms
        True
        >>> choose(Conditions(4), budget="1h")
        Traceback (most recent call last):
            ...
        ValueError: budget: expected a time or memory, such as 40ms, 2s, 25fps, 200MB or 1GiB, got '1h'
    """
    if (speed is None) == (budget is None):
        raise ValueError(f"speed, budget: expected one of them, got {speed!r} and {budget!r}")
    found = choices(conditions)
    if speed is not None:
        if speed not in SPEEDS:
            raise ValueError(f"speed: expected one of {', '.join(SPEEDS)}, got {speed!r}")
        near = [choice for choice in found if choice.below <= SPEEDS[speed]]
        return max((choice for choice in near if choice.ms <= _AS_FAST * near[0].ms), key=lambda choice: choice.psnr)
    read = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([a-zA-Z]+)\s*", budget)
    if read is None or read[2] not in (*_UNITS, "fps") or (read[2] == "fps" and not float(read[1])):
        raise ValueError(f"budget: expected a time or memory, such as 40ms, 2s, 25fps, 200MB or 1GiB, got {budget!r}")
    what, unit = _UNITS.get(read[2], ("ms", 1e3))
    limit = unit / float(read[1]) if read[2] == "fps" else unit * float(read[1])
    if what == "ms":
        here = pace(conditions)
        where = f"on this machine, which takes {here:.2g} times as long as that of the table"
        found = [replace(choice, ms=here * choice.ms, where=where) for choice in found]
    fitting = [choice for choice in found if getattr(choice, what) <= limit]
    if not fitting:
        least = min(found, key=lambda choice: getattr(choice, what))
        size = " x ".join(map(str, conditions.size))
        raise ValueError(f"budget: no preset fits {budget} at {size} sensor pixels; leanest: {least}")
    return max(fitting, key=lambda choice: choice.psnr)
