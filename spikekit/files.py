"""Recordings on disk: the field's packed ``.dat`` and NumPy's ``.npz``, read frame by frame."""

from __future__ import annotations

import math
import secrets
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import numpy as np
import torch
from torch import Tensor

from spikekit.check import check_planes

# What the field calls the array of a recording; without either name, the only 3-D array is taken.
_ARRAY_NAMES = ("spk", "spikes")


class SpikeFileError(ValueError):
    """A recording that cannot be read or written; the message is one line and names the file."""


def read_spikes(
    path: str | Path,
    height: int | None = None,
    width: int | None = None,
    *,
    flip: bool = False,
    start: int = 0,
    frames: int | None = None,
) -> Tensor:
    """Read a recording, or some frames of it.

    Convention:
        ``.dat`` has no header: frame after frame, row by row, 8 neighbouring pixels a byte, the leftmost in the least
        significant bit. Where 8 does not divide H x W, every frame is padded to whole bytes. ``.npz`` holds one array
        (T, H, W) of zeros and ones, named ``spk`` or ``spikes``, or the only 3-D array of the file.

        Real cameras store frames upside down, which neither format records: ``flip`` turns them. Pixel (0, 0) of the
        result is then the top left of the scene, and the Bayer phase counts from there.

        Of a ``.dat``, only the bytes of the frames asked for are read.

    Args:
        path: a file ending in ``.dat`` or ``.npz``.
        height: rows; needed for ``.dat``, checked against the file for ``.npz``.
        width: columns; likewise.
        flip: turn the stored frames upside down.
        start: the first frame to read.
        frames: how many; up to the end when not given.

    Returns:
        ``spikes`` of shape (T, H, W), uint8, zeros and ones.

    Raises:
        SpikeFileError: no such file, not a recording, damaged, truncated, of another size, or without these frames.

    Example:
        >>> import tempfile
        >>> spikes = (torch.rand(5, 3, 7) < 0.3).to(torch.uint8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_spikes(f"{folder}/clip.dat", spikes)
        ...     read_spikes(f"{folder}/clip.dat", 3, 7, start=2).equal(spikes[2:])
        True
    """
    shape, planes = _open(path, height, width, flip, start, frames)
    spikes = np.empty(shape, np.uint8)
    for plane, stored in zip(spikes, planes, strict=True):
        plane[:] = stored
    return torch.from_numpy(spikes)


def iter_spikes(
    path: str | Path,
    height: int | None = None,
    width: int | None = None,
    *,
    flip: bool = False,
    start: int = 0,
    frames: int | None = None,
) -> Iterator[Tensor]:
    """Read a recording frame by frame, for what is longer than the memory.

    Convention:
        Formats and arguments as in :func:`read_spikes`. What can be known without reading the frames is checked at
        the call, not at the first frame.

    Args:
        path: a file ending in ``.dat`` or ``.npz``.
        height: rows; needed for ``.dat``, checked against the file for ``.npz``.
        width: columns; likewise.
        flip: turn the stored frames upside down.
        start: the first frame to read.
        frames: how many; up to the end when not given.

    Returns:
        An iterator over frames (H, W), uint8, zeros and ones.

    Raises:
        SpikeFileError: as :func:`read_spikes`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_spikes(f"{folder}/clip.dat", torch.ones(5, 3, 7))
        ...     sum(int(frame.sum()) for frame in iter_spikes(f"{folder}/clip.dat", 3, 7))
        105
    """
    _, planes = _open(path, height, width, flip, start, frames)
    return (torch.from_numpy(np.ascontiguousarray(stored)) for stored in planes)


def spikes_shape(path: str | Path, height: int | None = None, width: int | None = None) -> tuple[int, int, int]:
    """Return (T, H, W) of a recording without reading its frames.

    Args:
        path: a file ending in ``.dat`` or ``.npz``.
        height: rows; needed for ``.dat``, checked against the file for ``.npz``.
        width: columns; likewise.

    Returns:
        Frames, rows and columns.

    Raises:
        SpikeFileError: as :func:`read_spikes`.
    """
    path = Path(path)
    with _reading(path):
        if path.is_dir():
            raise SpikeFileError(f"{path}: expected a recording, got a folder")
        if not path.is_file():
            raise SpikeFileError(f"{path}: no such file")
        size = path.stat().st_size
    if size == 0:
        raise SpikeFileError(f"{path}: an empty file, 0 bytes")
    if _check_suffix(path) == ".dat":
        return _dat_shape(path, size, height, width)
    return _npz_shape(path, height, width)


def write_spikes(path: str | Path, spikes: Tensor, *, flip: bool = False) -> None:
    """Write a recording; the folder is made when it is missing.

    Convention:
        Formats as in :func:`read_spikes`; the array of an ``.npz`` is called ``spk``. The file appears under its name
        once it is complete, so a run that is killed leaves no half recording.

    Args:
        path: where to, ending in ``.dat`` or ``.npz``.
        spikes: (T, H, W), zeros and ones, any real dtype.
        flip: store the frames upside down, as real cameras do.

    Raises:
        SpikeFileError: another ending, or the file cannot be written.
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: another shape, an empty clip, or values other than 0 and 1.
    """
    path = Path(path)
    suffix = _check_suffix(path)
    check_planes("spikes", spikes, 3, "(T, H, W)")
    if spikes.ndim != 3:
        raise ValueError(f"spikes: expected (T, H, W), got {tuple(spikes.shape)}")
    planes = (_binary(_to_numpy(plane), "spikes", n, ValueError) for n, plane in enumerate(spikes.detach()))
    if flip:
        planes = (plane[::-1] for plane in planes)

    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(part, "xb") as file:
            if suffix == ".dat":
                for plane in planes:
                    file.write(np.packbits(plane, bitorder="little").tobytes())
            else:
                np.savez_compressed(file, spk=np.stack(list(planes)))
        part.replace(path)
    except OSError as error:
        raise SpikeFileError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _open(
    path: str | Path, height: int | None, width: int | None, flip: bool, start: int, frames: int | None
) -> tuple[tuple[int, int, int], Iterator[np.ndarray]]:
    """Check everything but the frames themselves; return the shape of what will be read, and its frames."""
    path = Path(path)
    total, height, width = spikes_shape(path, height, width)
    if frames is None:
        frames = total - start
    if start < 0 or frames < 1 or start + frames > total:
        raise SpikeFileError(f"{path}: expected frames within 0 .. {total - 1}, got {frames} from frame {start} on")
    read = _dat_planes if path.suffix.lower() == ".dat" else _npz_planes
    planes = read(path, height, width, start, frames)
    return (frames, height, width), (plane[::-1] for plane in planes) if flip else planes


def _check_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in (".dat", ".npz"):
        raise SpikeFileError(f"{path}: expected a recording that ends in .dat or .npz, got {suffix or 'no ending'}")
    return suffix


def _to_numpy(plane: Tensor) -> np.ndarray:
    return (plane.float() if plane.dtype is torch.bfloat16 else plane).cpu().numpy()  # NumPy has no bfloat16


def _binary(plane: np.ndarray, name: str, n: int, error: type[ValueError]) -> np.ndarray:
    """Return a frame as uint8; raise ``error`` unless it holds zeros and ones only."""
    bits = (plane != 0).astype(np.uint8)
    if not np.array_equal(bits, plane):
        raise error(f"{name}: expected zeros and ones, got values from {plane.min()} to {plane.max()} in frame {n}")
    return bits


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong with the bytes of a file into one line."""
    try:
        yield
    except (SpikeFileError, MemoryError):
        raise
    except OSError as error:
        raise SpikeFileError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:
        raise SpikeFileError(f"{path}: damaged ({' '.join(str(error).split()) or type(error).__name__})") from error


def _frame_bytes(height: int, width: int) -> int:
    return -(-height * width // 8)


def _dat_shape(path: Path, size: int, height: int | None, width: int | None) -> tuple[int, int, int]:
    if height is None or width is None:
        raise SpikeFileError(f"{path}: a .dat has no header, expected height and width, got {height} and {width}")
    if height < 1 or width < 1:
        raise SpikeFileError(f"{path}: expected a height and a width of at least 1, got {height} and {width}")
    step = _frame_bytes(height, width)
    whole, rest = divmod(size, step)
    if rest:
        raise SpikeFileError(
            f"{path}: truncated, or not {height} x {width}: {size} bytes at {step} bytes a frame make {whole} whole "
            f"frames and {rest} bytes left over"
        )
    return whole, height, width


def _dat_planes(path: Path, height: int, width: int, start: int, frames: int) -> Iterator[np.ndarray]:
    step = _frame_bytes(height, width)
    with _reading(path), open(path, "rb") as file:
        file.seek(start * step)
        for n in range(start, start + frames):
            packed = np.frombuffer(file.read(step), np.uint8)
            if packed.size < step:
                raise SpikeFileError(f"{path}: truncated while it was read, at frame {n}")
            yield np.unpackbits(packed, count=height * width, bitorder="little").reshape(height, width)


def _npz_shape(path: Path, height: int | None, width: int | None) -> tuple[int, int, int]:
    with _npz_array(path) as (_, shape, _, _):
        pass
    if height not in (None, shape[1]) or width not in (None, shape[2]):
        raise SpikeFileError(f"{path}: holds frames of {shape[1]} x {shape[2]}, got height {height} and width {width}")
    return shape


def _npz_planes(path: Path, height: int, width: int, start: int, frames: int) -> Iterator[np.ndarray]:
    with _npz_array(path) as (stream, shape, dtype, fortran):
        step = height * width * dtype.itemsize
        if fortran:
            array = np.frombuffer(stream.read(), dtype).reshape(shape, order="F")[start : start + frames]
        else:
            stream.seek(start * step, 1)
            array = (np.frombuffer(stream.read(step), dtype).reshape(height, width) for _ in range(frames))
        for n, plane in enumerate(array, start):
            yield _binary(plane, str(path), n, SpikeFileError)


@contextmanager
def _npz_array(path: Path) -> Iterator[tuple[IO[bytes], tuple[int, int, int], np.dtype, bool]]:
    """Open the recording in an ``.npz`` at its first number: the stream, shape, dtype, and whether in Fortran order."""
    with _reading(path), zipfile.ZipFile(path) as archive:
        headers = {}
        for member in archive.infolist():
            if not member.filename.endswith(".npy"):
                continue
            with archive.open(member) as stream:
                headers[member.filename.removesuffix(".npy")] = member, *_npy_header(stream)
        named = [name for name in _ARRAY_NAMES if name in headers]
        solid = [name for name, (_, shape, _, _) in headers.items() if len(shape) == 3]
        name = (named or solid or [""])[0]
        if name not in solid or (not named and len(solid) > 1):
            found = ", ".join(f"{name} {shape}" for name, (_, shape, _, _) in headers.items())
            raise SpikeFileError(
                f"{path}: expected one array (T, H, W) of zeros and ones, named {' or '.join(_ARRAY_NAMES)} or the "
                f"only one of three dimensions, got {found or 'no array'}"
            )
        member, shape, fortran, dtype = headers[name]
        if dtype.kind not in "buif":
            raise SpikeFileError(f"{path}: expected an array of zeros and ones, got {name} of type {dtype}")
        if 0 in shape:
            raise SpikeFileError(f"{path}: an empty recording, {name} is {shape}")
        with archive.open(member) as stream:
            _npy_header(stream)
            present, needed = member.file_size - stream.tell(), math.prod(shape) * dtype.itemsize
            if present != needed:
                raise SpikeFileError(
                    f"{path}: truncated, {name} of {shape} takes {needed} bytes, the file holds {present}"
                )
            yield stream, shape, dtype, fortran


def _npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(stream)
