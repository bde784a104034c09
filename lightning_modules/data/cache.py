"""Cache of simulated clips on disk: packed, keyed by what they were made of, verified by digest."""

from __future__ import annotations

import hashlib
import io
import json
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spikekit import pack_spikes, unpack_spikes
from spikekit.io.whole_file import whole_file

_DIGEST = 32  # bytes of a SHA-256


class ClipCache:
    """A folder of clips that are slow to make.

    A clip is a file, named after its key. It is written as :func:`spikekit.io.whole_file.whole_file` does: a run that
    is killed leaves a part that nobody looks at, and of two processes that write a clip the last one wins. Before the
    arrays stands a digest of the key and all bytes; a file that does not agree with it is removed and made again. A
    clip that cannot be written, as on a full disk, is warned of once and made again the next time.

    Nothing is ever removed for its size or age: delete the folder, or any files in it, at any time.

    Args:
        folder: where; made when it is missing.

    Raises:
        OSError: the folder cannot be made.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     cache = ClipCache(folder)
        ...     key = clip_key(scale=4, frames=["digest of a file"])
        ...     first = cache.load(key)
        ...     cache.store(key, {"spikes": np.zeros(3, "uint8")})
        ...     first, cache.load(key)
        (None, {'spikes': array([0, 0, 0], dtype=uint8)})
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._warned = False

    def load(self, key: str) -> dict[str, np.ndarray] | None:
        """Return the arrays of a clip, or None where there are none, or damaged ones."""
        path = self._path(key)
        try:
            stored = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._warn(f"{path}: cannot be read ({error.strerror or error})")
            return None
        if stored[:_DIGEST] != _digest(key, memoryview(stored)[_DIGEST:]):
            warnings.warn(f"{path}: damaged, made again", stacklevel=2)
            with suppress(OSError):
                path.unlink()
            return None
        try:
            with np.load(io.BytesIO(stored[_DIGEST:]), allow_pickle=False) as arrays:
                return dict(arrays)
        except Exception as error:  # somebody wrote the digest of something else
            self._warn(f"{path}: holds no clip ({type(error).__name__}), made again")
            return None

    def store(self, key: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep the arrays of a clip."""
        path = self._path(key)
        stored = io.BytesIO()
        np.savez(stored, **arrays)
        stored = stored.getbuffer()
        try:
            with whole_file(path) as file:
                file.write(_digest(key, stored))
                file.write(stored)
        except OSError as error:
            self._warn(f"{path}: cannot be written ({error.strerror or error}), goes on without")

    def packed(self, key: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, np.ndarray]:
        """Return a clip that is here, or make it and keep it, as :func:`pack_clip` does."""
        packed = self.load(key)
        if packed is None:
            packed = pack_clip(make())
            self.store(key, packed)
        return packed

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key[2:]}.clip"

    def _warn(self, message: str) -> None:
        if not self._warned:
            warnings.warn(message, stacklevel=3)
        self._warned = True


def _digest(key: str, stored: memoryview) -> bytes:
    digest = hashlib.sha256(key.encode())
    digest.update(stored)
    return digest.digest()


def clip_key(**what: object) -> str:
    """Return the name of a clip: a digest of all that it was made of.

    Args:
        what: plain values, lists and dictionaries of them.

    Returns:
        64 hexadecimal digits.

    Example:
        >>> clip_key(scale=4, alpha=0.4) == clip_key(alpha=0.4, scale=4) != clip_key(alpha=0.4, scale=2)
        True
    """
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """Return a digest of a file's bytes, computed once per process as long as the file does not change.

    Raises:
        OSError: the file cannot be read.
    """
    stat = path.stat()
    return _file_digest(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=1 << 16)
def _file_digest(path: Path, size: int, time_ns: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def pack_clip(clip: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Pack a clip, losslessly except for flow, which is rounded to half precision.

    Spikes become bits. A picture of at most 256 (65,536) values, as one that was read from a file of 8 (16) bits,
    becomes numbers of 8 (16) bits and a table.

    Args:
        clip: ``spikes`` (N, H, W) of zeros and ones, ``rgb`` (..., 3, s H, s W), perhaps ``flow`` (times, 2, H, W).

    Returns:
        Arrays for :func:`unpack_clip`.

    Example:
        >>> clip = {"spikes": torch.ones(41, 6, 10), "rgb": torch.rand(3, 12, 20)}
        >>> {name: (array.shape, str(array.dtype)) for name, array in pack_clip(clip).items()}
        {'spikes': ((41, 6, 2), 'uint8'), 'rgb': ((3, 12, 20), 'uint16'), 'shades': ((720,), 'float32')}
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
    """Undo :func:`pack_clip` for a rectangle of the sensor.

    Args:
        packed: what it returned.
        part: first row, first column, rows and columns.
        scale: pixels of the picture for a sensor pixel.

    Returns:
        ``spikes`` uint8 (N, H, W), ``rgb`` (..., 3, s H, s W), and ``flow`` (times, 2, H, W) float32, if any.

    Example:
        >>> clip = {"spikes": torch.rand(41, 6, 10).round(), "rgb": torch.rand(3, 12, 20)}
        >>> again = unpack_clip(pack_clip(clip), (2, 3, 4, 6), scale=2)
        >>> bool((again["spikes"] == clip["spikes"][:, 2:6, 3:9]).all())
        True
        >>> bool((again["rgb"] == clip["rgb"][:, 4:12, 6:18]).all())
        True
    """
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
