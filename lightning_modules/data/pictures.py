"""Source pictures of the scenes: any folder, or the photographs inside scikit-image's wheel."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

import numpy as np
from torch import Tensor

from spikekit import read_picture

_ENDINGS = {".png", ".jpg", ".jpeg", ".jpe", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".pnm"}

# Colour first, then grey. motorcycle_right is left out: it shows what is held out.
_TRAIN = [
    "astronaut.png",
    "rocket.jpg",
    "ihc.png",
    "retina.jpg",
    "hubble_deep_field.jpg",
    "brick.png",
    "grass.png",
    "camera.png",
    "moon.png",
    "coins.png",
    "page.png",
]
_HELD_OUT = ["coffee.png", "chelsea.png", "motorcycle_left.png", "gravel.png"]


def existing_folder(root: str | Path, what: str) -> Path:
    """Return the path of a folder of ``what``, or raise ``FileNotFoundError`` or ``NotADirectoryError``."""
    root = Path(root).expanduser()
    if not root.exists():
        raise FileNotFoundError(f"{root}: no such folder of {what}")
    if not root.is_dir():
        raise NotADirectoryError(f"{root}: expected a folder of {what}, got a file")
    return root


def folder_pictures(root: str | Path) -> list[Path]:
    """List the pictures of a folder and of all folders in it, linked ones too, sorted; hidden ones are left out."""
    root = existing_folder(root, "pictures")
    found, seen = [], set()
    for folder, folders, names in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        folders[:] = [] if real in seen else [name for name in folders if not name.startswith(".")]
        if real not in seen:  # a link may lead back
            paths = [Path(folder, name) for name in names if not name.startswith(".")]
            found += [path for path in paths if path.suffix.lower() in _ENDINGS and path.is_file()]
        seen.add(real)
    found.sort()
    if not found:
        raise FileNotFoundError(f"{root}: no picture in this folder (looked for {' '.join(sorted(_ENDINGS))})")
    return found


def embedded_pictures(held_out: bool = False) -> list[Path]:
    """List the photographs inside scikit-image's wheel, for training or the four held out; nothing is ever downloaded.

    Raises:
        FileNotFoundError: this build of scikit-image came without any of them.
    """
    import skimage.data

    here = Path(skimage.data.__file__).parent
    found = [here / name for name in (_HELD_OUT if held_out else _TRAIN) if (here / name).is_file()]
    if not found:
        raise FileNotFoundError(f"{here}: scikit-image came without its photographs; give a folder of pictures instead")
    return found


def split_pictures(pictures: list[Path], seed: int) -> tuple[list[Path], list[Path]]:
    """Hold out one picture in twenty at random, but four where there are eight or more, and half of fewer.

    Returns what stays, and what is held out, each in the order given. One picture alone is in both.
    """
    if len(pictures) == 1:
        return pictures, pictures
    count = max(round(len(pictures) / 20), min(4, len(pictures) // 2))
    out = set(np.random.default_rng(seed).permutation(len(pictures))[:count].tolist())
    return (
        [picture for i, picture in enumerate(pictures) if i not in out],
        [picture for i, picture in enumerate(pictures) if i in out],
    )


@lru_cache(maxsize=64)
def read_shades(path: Path) -> Tensor:
    """Read a picture as numbers of 8 bits, (3, h, w), or give the one in memory; not to be written to."""
    return to_shades(read_picture(path))


def to_shades(rgb: Tensor) -> Tensor:
    """Turn values of [0, 1] into numbers of 8 bits."""
    return (rgb * 255).round().byte()
