"""The weights that come with the package, by name."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from functools import lru_cache
from math import prod
from pathlib import Path

from safetensors import safe_open

FOLDER = Path(__file__).parents[1] / "weights"
#: how the names of weights begin that a network for films has beside those of the network for a clip
FUSION = "fusion."


@dataclass(frozen=True)
class Pretrained:
    """Weights that come with the package: a row of ``weights/index.csv``.

    Args:
        name: what ``from_pretrained`` and ``--model.weights`` call them, such as ``"cscsr_small_x4"``.
        path: their file; that of a network for films holds those of the network for a clip which it contains.
        former: an older name, which goes on working; None where there is none.
        scale: super-resolution factor; None for an estimator of motion.
        size: of the network, as in ``configs/size``; None for an estimator of motion.
        halo: of the network with these weights, measured; None for an estimator of motion.
        macs: multiplications of a picture, or of an estimate of motion, by sensor pixel: those of convolutions and
            matrices, as ``lightning trade`` counts them.
        kodak: PSNR in dB of Kodak's 24 stills in motion, as on the card of the weights; None for an estimator.
        vid4: PSNR in dB of Vid4's clips foliage and walk, 20 clocks a frame; None for an estimator.
    """

    name: str
    path: Path
    former: str | None = None
    scale: int | None = None
    size: str | None = None
    halo: int | None = None
    macs: int | None = None
    kodak: float | None = None
    vid4: float | None = None

    @property
    def film(self) -> bool:
        """Whether the network makes films."""
        return (self.size or "").endswith("_film")

    @property
    def parameters(self) -> int:
        """Number of learned parameters, including those of a motion estimator inside."""
        with safe_open(self.path, "numpy") as file:
            own = [name for name in file.keys() if self.film or not name.startswith(FUSION)]  # noqa: SIM118
            return sum(prod(file.get_slice(name).get_shape()) for name in own)

    @property
    def frames(self) -> int | None:
        """Spike frames of a clip; None for an estimator of motion."""
        with safe_open(self.path, "numpy") as file:
            return json.loads(file.metadata()["network"]).get("frames")


@lru_cache(maxsize=1)
def _index() -> tuple[Pretrained, ...]:
    with open(FOLDER / "index.csv", newline="") as file:
        return tuple(
            Pretrained(
                row["name"],
                FOLDER / row["file"],
                row["former"] or None,
                size=row["size"] or None,
                **{name: int(row[name]) if row[name] else None for name in ("scale", "halo", "macs")},
                **{name: float(row[name]) if row[name] else None for name in ("kodak", "vid4")},
            )
            for row in csv.DictReader(file)
        )


def list_pretrained(scale: int | None = None) -> list[Pretrained]:
    """List the weights that come with the package, smaller scales and smaller networks first.

    Args:
        scale: only those of this super-resolution factor; when not given, all, and the estimators of motion.

    Example:
        >>> [(weights.name, weights.size, weights.parameters, weights.macs) for weights in list_pretrained(4)][:2]
        [('cscsr_tiny_x4', 'tiny', 300963, 356394), ('cscsr_small_x4', 'small', 1080294, 1480530)]
        >>> max(list_pretrained(4), key=lambda weights: weights.kodak).name
        'cscsr_huge_x4'
    """
    return [weights for weights in _index() if scale is None or weights.scale == scale]


def shipped_weights() -> dict[str, Path]:
    """Return the files of weights that come with the package, by name."""
    return {weights.name: weights.path for weights in _index()}


def find_shipped(name: str) -> Pretrained | None:
    """Find weights that come with the package, by their name or a former one."""
    return next((weights for weights in _index() if name in (weights.name, weights.former)), None)
