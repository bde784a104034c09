"""Source pictures of scenes, from a folder or from the photographs in scikit-image."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

import numpy as np
from torch import Tensor

from spikekit import read_picture

_ENDINGS = {".png", ".jpg", ".jpeg", ".jpe", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm", ".pnm"}

# colour first, then grey; without motorcycle_right, which shows the scene of a held-out picture
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
    """List the pictures of a folder and its subfolders, sorted; links are followed, hidden files left out."""
    root = existing_folder(root, "pictures")
    found, seen = [], set()
    for folder, folders, names in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        folders[:] = [] if real in seen else [name for name in folders if not name.startswith(".")]
        if real not in seen:  # links may form a cycle
            paths = [Path(folder, name) for name in names if not name.startswith(".")]
            found += [path for path in paths if path.suffix.lower() in _ENDINGS and path.is_file()]
        seen.add(real)
    found.sort()
    if not found:
        raise FileNotFoundError(f"{root}: no picture in this folder (looked for {' '.join(sorted(_ENDINGS))})")
    return found


def embedded_pictures(held_out: bool = False) -> list[Path]:
    """List the photographs installed with scikit-image, for training or the four held out; nothing is downloaded."""
    import skimage.data

    here = Path(skimage.data.__file__).parent
    found = [here / name for name in (_HELD_OUT if held_out else _TRAIN) if (here / name).is_file()]
    if not found:
        raise FileNotFoundError(f"{here}: scikit-image has no photographs here; give a folder of pictures instead")
    return found


def split_pictures(pictures: list[Path], seed: int) -> tuple[list[Path], list[Path]]:
    """Split pictures at random into training and held-out ones, each in the given order.

    One picture in twenty is held out, but at least four, or half if there are fewer than eight. A single picture is in
    both parts.
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
    """Read a picture as uint8, (3, h, w); recent ones are shared from memory, so do not modify them."""
    return to_shades(read_picture(path))


def to_shades(rgb: Tensor) -> Tensor:
    """Convert values in [0, 1] to uint8."""
    return (rgb * 255).round().byte()
