"""Cache of simulated clips on disk, packed and keyed by their inputs."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spikekit import pack_spikes, unpack_spikes
from spikekit.arguments import one_line
from spikekit.io.whole_file import whole_file


class ClipCache:
    """A folder of clips that are slow to make.

    A clip is an npz file, named after its key and protected by checksums. A clip that cannot be read is made again; one
    that cannot be written, as on a full disk, is not kept. Only the first such failure gives a warning.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._warned = False

    def packed(self, key: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, np.ndarray]:
        """Return a clip from the folder, or make and keep it, in the form of :func:`pack_clip`."""
        path = self.folder / key[:2] / f"{key[2:]}.npz"
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
                return dict(arrays)
        except FileNotFoundError:
            pass
        except Exception as error:  # the type depends on the damage
            self._warn(f"{path}: cannot be read ({one_line(error)[:300]}), made again")
        packed = pack_clip(make())
        try:
            with whole_file(path) as file:
                np.savez(file, **packed)
        except OSError as error:
            self._warn(f"{path}: cannot be written ({one_line(error)}), not kept")
        return packed

    def _warn(self, message: str) -> None:
        if not self._warned:
            warnings.warn(message, stacklevel=3)
        self._warned = True


def clip_key(**what: object) -> str:
    """Return the key of a clip: a digest of its inputs, which are plain values, lists and dictionaries.

    Example:
        >>> clip_key(scale=4, alpha=0.4) == clip_key(alpha=0.4, scale=4) != clip_key(alpha=0.4, scale=2)
        True
    """
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """Return a digest of a file, computed once per process while the file does not change."""
    stat = path.stat()
    return _file_digest(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=1 << 16)
def _file_digest(path: Path, size: int, time_ns: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def pack_clip(clip: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Pack a clip, losslessly except for the flow, which is rounded to half precision.

    Spikes are packed to bits. A picture with at most 256 (65,536) different values, as from a file with 8 (16) bits,
    becomes integers of 8 (16) bits and their table of values, ``shades``.
    """
    shades, rgb = np.unique(clip["rgb"].numpy(), return_inverse=True)
    packed = {"spikes": pack_spikes(clip["spikes"]).numpy()}
    if len(shades) <= 1 << 16:
        small = np.uint8 if len(shades) <= 1 << 8 else np.uint16
        packed |= {"rgb": rgb.reshape(clip["rgb"].shape).astype(small), "shades": shades}
    else:
        packed["rgb"] = clip["rgb"].numpy()
    if "flow" in clip:
        packed["flow"] = clip["flow"].half().numpy()
    return packed


def unpack_clip(packed: Mapping[str, np.ndarray], part: tuple[int, int, int, int], scale: int) -> dict[str, Tensor]:
    """Unpack a part of the sensor (first row, first column, rows, columns) from a clip of :func:`pack_clip`."""
    top, left, height, width = part
    rows, first = slice(top, top + height), left // 8
    bits = np.ascontiguousarray(packed["spikes"][:, rows, first : -(-(left + width) // 8)])
    skipped = left - 8 * first
    spikes = unpack_spikes(torch.from_numpy(bits), skipped + width)[..., skipped:].contiguous()
    rgb = packed["rgb"][..., scale * top : scale * (top + height), scale * left : scale * (left + width)]
    rgb = packed["shades"][rgb] if "shades" in packed else np.ascontiguousarray(rgb)
    clip = {"spikes": spikes, "rgb": torch.from_numpy(rgb)}
    if "flow" in packed:
        clip["flow"] = torch.from_numpy(packed["flow"][:, :, rows, left : left + width].astype("float32"))
    return clip
