"""Registry of the weights in the package, the rows of ``weights/models.csv``."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from math import prod
from pathlib import Path

from safetensors import safe_open

_FOLDER = Path(__file__).parent / "weights"


@dataclass(frozen=True)
class Model:
    """Weights in the package.

    Args:
        name: name for ``from_pretrained`` and ``--model.weights``, such as ``"cscsr_small_x4"``.
        scale: super-resolution factor s; None for motion estimators, as are the next four.
        pattern: Bayer phase, or ``"grey"``.
        size: name in :data:`lightning_modules.networks.sizes.SIZES`.
        frames: number of spike frames per clip.
        margin: radius of the receptive field in sensor pixels, measured with these weights.
        search: the network searches along estimated motion.
        film: the network also uses the neighbouring key frames of a film.
        noise: the network was trained for noisy sensors without calibration.
        macs: multiplications per sensor pixel for the picture of a single clip or one motion estimate.
        kodak: PSNR in dB on Kodak's 24 stills in motion, or None.
        vid4: PSNR in dB on foliage and walk of Vid4, as films, with 20 clocks per source frame, or None.
    """

    name: str
    scale: int | None
    pattern: str | None
    size: str | None
    frames: int | None
    margin: int | None
    search: bool
    film: bool
    noise: bool
    macs: int
    kodak: float | None
    vid4: float | None

    @property
    def path(self) -> Path:
        """Path of the file."""
        return _FOLDER / f"{self.name}.safetensors"

    @property
    def parameters(self) -> int:
        """Number of learned parameters, including those of a learned motion estimator."""
        with safe_open(self.path, "numpy") as file:
            return sum(prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118


def list_models(scale: int | None = None, pattern: str | None = None) -> list[Model]:
    """List the weights in the package, smaller scales and smaller networks first.

    Args:
        scale: super-resolution factor to select. Default: any, including motion estimators.
        pattern: Bayer phase or ``"grey"`` to select. Default: any, including motion estimators.

    Example:
        >>> [(model.name, model.size, model.frames, model.macs) for model in list_models(scale=4)][:2]
        [('cscsr_micro_x4', 'micro', 41, 163584), ('cscsr_tiny_x4', 'tiny', 41, 356394)]
        >>> max(list_models(scale=4), key=lambda model: model.kodak).name
        'cscsr_huge_x4'
    """
    return [one for one in _models() if scale in (None, one.scale) and pattern in (None, one.pattern)]


def for_noise(scale: int) -> dict[str, str]:
    """Map weights to those of the same network that were trained for noisy sensors, which may be the same.

    Example:
        >>> for_noise(4)["cscsr_huge_x4"]
        'cscsr_huge_noisy_x4'
    """
    models = list_models(scale)
    noisy = {(one.size, one.frames, one.pattern): one.name for one in models if one.noise}
    keys = {one.name: (one.size, one.frames, one.pattern) for one in models}
    return {name: noisy[key] for name, key in keys.items() if key in noisy}


def find_model(name: str) -> Model | None:
    """Find weights in the package by name; return None if there are none.

    Example:
        >>> find_model("cscsr_small_x4").scale
        4
    """
    return next((one for one in _models() if one.name == name), None)


@lru_cache(maxsize=1)
def _models() -> tuple[Model, ...]:
    with open(_FOLDER / "models.csv", newline="", encoding="utf-8") as file:
        return tuple(map(_model, csv.DictReader(file)))


def _model(row: dict[str, str]) -> Model:
    return Model(
        row["name"],
        pattern=row["pattern"] or None,
        size=row["size"] or None,
        **{name: row[name] == "1" for name in ("search", "film", "noise")},
        macs=int(row["macs"]),
        **{name: int(row[name]) if row[name] else None for name in ("scale", "frames", "margin")},
        **{name: float(row[name]) if row[name] else None for name in ("kodak", "vid4")},
    )
