"""Registry of models: the weights that come with the package, one row of ``weights/models.csv`` each."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from math import prod
from pathlib import Path

from safetensors import safe_open

#: how the names of weights begin that a network for films has beside those of the network for a clip
FUSION = "fusion."

_FOLDER = Path(__file__).parent / "weights"


@dataclass(frozen=True)
class Model:
    """Weights that come with the package.

    Args:
        name: what ``from_pretrained`` and ``--model.weights`` call them, such as ``"cscsr_small_x4"``.
        file: their file in ``weights``. That of a network for films also holds the network for a clip inside it.
        scale: super-resolution factor; None for an estimator of motion, like everything up to ``margin``.
        pattern: Bayer phase, or ``"grey"``.
        size: one of :data:`lightning_modules.networks.sizes.SIZES`.
        frames: spike frames of a clip.
        margin: how many sensor pixels around a place the network sees, measured with these weights.
        film: whether it uses the neighbouring key frames of a film.
        noise: whether it was trained for noisy sensors that were not calibrated.
        macs: multiplications by sensor pixel of a picture, or of an estimate of motion.
        kodak: PSNR in dB of Kodak's 24 stills in motion; None for an estimator.
        vid4: PSNR in dB of Vid4's clips foliage and walk, 20 clocks a frame; None for an estimator.
    """

    name: str
    file: str
    scale: int | None
    pattern: str | None
    size: str | None
    frames: int | None
    margin: int | None
    film: bool
    noise: bool
    macs: int
    kodak: float | None
    vid4: float | None

    @property
    def path(self) -> Path:
        """Where the file is."""
        return _FOLDER / self.file

    @property
    def parameters(self) -> int:
        """Number of learned parameters, including those of a motion estimator inside."""
        with safe_open(self.path, "numpy") as file:
            own = [name for name in file.keys() if self.film or not name.startswith(FUSION)]  # noqa: SIM118
            return sum(prod(file.get_slice(name).get_shape()) for name in own)


def list_models(scale: int | None = None, pattern: str | None = None) -> list[Model]:
    """List the weights that come with the package, smaller scales and smaller networks first.

    Args:
        scale: only networks of this super-resolution factor; when not given, all, and the estimators of motion.
        pattern: only networks for this Bayer phase, or for ``"grey"``; likewise.

    Example:
        >>> [(model.name, model.size, model.frames, model.macs) for model in list_models(scale=4)][:2]
        [('cscsr_tiny_x4', 'tiny', 41, 356394), ('cscsr_small_x4', 'small', 41, 1480530)]
        >>> max(list_models(scale=4), key=lambda model: model.kodak).name
        'cscsr_huge_x4'
    """
    return [one for one in _models() if scale in (None, one.scale) and pattern in (None, one.pattern)]


def find_model(name: str) -> Model | None:
    """Find weights that come with the package by their name.

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
        row["file"],
        pattern=row["pattern"] or None,
        size=row["size"] or None,
        film=row["film"] == "1",
        noise=row["noise"] == "1",
        macs=int(row["macs"]),
        **{name: int(row[name]) if row[name] else None for name in ("scale", "frames", "margin")},
        **{name: float(row[name]) if row[name] else None for name in ("kodak", "vid4")},
    )
