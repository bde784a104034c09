"""File formats of recordings, read and written in blocks of frames: packed ``.dat``, NumPy's ``.npy`` and ``.npz``."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from spikekit.io import failures
from spikekit.io.cameras import usual_sizes
from spikekit.io.quiet import quiet

# Usual names of the array of a recording; without either, the only 3-D array is read.
_ARRAY_NAMES = ("spk", "spikes")


# Largest compression ratio of Deflate.
_MOST_DEFLATED = 1032

_MOST_HEADER = 16_384  # bytes; NumPy rejects headers above 10,000


class SpikeFileError(ValueError):
    """An unreadable recording or a wrong ending; the message is one line and names the file."""


reading = partial(failures.reading, kind=SpikeFileError, otherwise="damaged ({})")


class Wanted(NamedTuple):
    """A request for ``frames`` frames from ``start`` on, in blocks of ``chunk``, flipped or packed if set."""

    path: Path
    height: int
    width: int
    start: int
    frames: int
    chunk: int
    flip: bool = False
    packed: bool = False

    def chunks(self) -> Iterator[tuple[int, int]]:
        """Return the first frame and the number of frames of every block."""
        stop = self.start + self.frames
        return ((n, min(self.chunk, stop - n)) for n in range(self.start, stop, self.chunk))

    def assemble(self, planes: Iterable[np.ndarray], count: int) -> np.ndarray:
        """Stack stored frames (H, W) of zeros and ones, flipped and packed as requested."""
        block = np.empty((count, self.height, -(-self.width // 8) if self.packed else self.width), np.uint8)
        for place, plane in zip(block, planes, strict=True):
            upright = plane[::-1] if self.flip else plane
            place[:] = np.packbits(upright, axis=-1, bitorder="little") if self.packed else upright
        return block


def binary(frames: np.ndarray, name: str, first: int, error: type[ValueError]) -> np.ndarray:
    """Return frames (N, H, W) as uint8; raise ``error`` unless they hold zeros and ones only."""
    if frames.dtype == np.bool_ or (frames.dtype == np.uint8 and frames.max() <= 1):
        return frames.view(np.uint8)
    bits = (frames != 0).view(np.uint8)
    if not np.array_equal(bits, frames):
        n = int((bits != frames).any(axis=(1, 2)).argmax())
        low, high = frames[n].min(), frames[n].max()
        raise error(f"{name}: expected zeros and ones, got values from {low} to {high} in frame {first + n}")
    return bits


# --- .dat -------------------------------------------------------------------------------------------------------------


def dat_shape(path: Path, size: int, height: int | None, width: int | None) -> tuple[int, int, int]:
    """Return (T, H, W) of a file of ``size`` bytes."""
    if height is None or width is None:
        raise SpikeFileError(f"{path}: a .dat has no header, expected height and width, got {height} and {width}")
    if height < 1 or width < 1:
        raise SpikeFileError(f"{path}: expected a height and a width of at least 1, got {height} and {width}")
    step = _frame_bytes(height, width)
    whole, rest = divmod(size, step)
    if rest:
        found = f"{size} bytes at {step} bytes per frame give {whole} whole frames and {rest} extra bytes"
        raise SpikeFileError(f"{path}: truncated, or not {height} x {width}: {found}")
    return whole, height, width


def dat_blocks(wanted: Wanted) -> Iterator[np.ndarray]:
    """Read blocks of frames (N, H, W), uint8, from a ``.dat`` file."""
    with reading(wanted.path), open(wanted.path, "rb") as file:
        yield from stored_blocks(file, wanted)


def stored_blocks(file: IO[bytes], wanted: Wanted) -> Iterator[np.ndarray]:
    """Read blocks of frames (N, H, W), uint8, from an open ``.dat`` file."""
    path, height, width = wanted[:3]
    step = _frame_bytes(height, width)
    with reading(path):
        file.seek(wanted.start * step)
        for n, count in wanted.chunks():
            stored = np.fromfile(file, np.uint8, count * step)
            if stored.size < count * step:
                raise SpikeFileError(f"{path}: truncated while it was read, at frame {n + stored.size // step}")
            if width % 8:  # rows may start within a byte
                frames = stored.reshape(count, step)
                bits = (np.unpackbits(frame, count=height * width, bitorder="little") for frame in frames)
                yield wanted.assemble((plane.reshape(height, width) for plane in bits), count)
            else:  # flipping bytes is faster than flipping pixels
                rows = stored.reshape(count, height, width // 8)
                rows = rows[:, ::-1].copy() if wanted.flip else rows
                yield rows if wanted.packed else np.unpackbits(rows, axis=-1, bitorder="little")


def dat_bytes(frames: np.ndarray) -> bytes:
    """Pack frames (N, H, W) of zeros and ones."""
    return np.packbits(frames.reshape(len(frames), -1), axis=-1, bitorder="little").tobytes()


def _frame_bytes(height: int, width: int) -> int:
    return -(-height * width // 8)


# --- .npy and .npz ----------------------------------------------------------------------------------------------------


def array_shape(path: Path, height: int | None, width: int | None) -> tuple[int, int, int]:
    """Return (T, H, W) of a ``.npy`` or ``.npz`` file."""
    with _array(path) as (_, shape, _, _):
        pass
    sizes = usual_sizes() if height is width is None else {(height, width)}
    if shape[:2] in sizes and shape[1:] not in sizes:
        raise SpikeFileError(f"{path}: expected an array (T, H, W), got {shape}, which looks like (H, W, T)")
    if height not in (None, shape[1]) or width not in (None, shape[2]):
        raise SpikeFileError(f"{path}: holds frames of {shape[1]} x {shape[2]}, got height {height} and width {width}")
    return shape


def array_blocks(wanted: Wanted) -> Iterator[np.ndarray]:
    """Read blocks of frames (N, H, W), uint8, from a ``.npy`` or ``.npz`` file."""
    path, height, width, start, frames = wanted[:5]
    with _array(path) as (stream, shape, dtype, fortran):
        if fortran:  # frames are not contiguous
            array = iter(np.frombuffer(stream.read(), dtype).reshape(shape, order="F")[start : start + frames])
        else:
            step = height * width * dtype.itemsize
            stream.seek(start * step, 1)
            array = (np.frombuffer(stream.read(step), dtype).reshape(height, width) for _ in range(frames))
        planes = (binary(plane[None], str(path), n, SpikeFileError)[0] for n, plane in enumerate(array, start))
        for _, count in wanted.chunks():
            yield wanted.assemble(islice(planes, count), count)


def write_array(file: IO[bytes], ending: str, shape: tuple[int, int, int], blocks: Iterable[np.ndarray]) -> None:
    """Write blocks of frames, (T, H, W) in all, to an open ``.npy`` or ``.npz``."""
    with ExitStack() as stack:
        if ending == ".npz":
            archive = stack.enter_context(zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED))
            file = stack.enter_context(archive.open(f"{_ARRAY_NAMES[0]}.npy", "w", force_zip64=True))
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
        for block in blocks:
            file.write(block)


@contextmanager
def _array(path: Path) -> Iterator[tuple[IO[bytes], tuple[int, int, int], np.dtype, bool]]:
    """Open the array of a recording behind its header; give the stream, shape, dtype, and whether in Fortran order."""
    with reading(path), ExitStack() as stack:
        size, name = path.stat().st_size, "the array"
        if path.suffix.lower() == ".npy":
            stream = stack.enter_context(open(path, "rb"))
        else:
            archive = stack.enter_context(zipfile.ZipFile(path))
            member = _member(path, archive)
            name = member.filename.removesuffix(".npy")
            if member.file_size > _MOST_DEFLATED * min(member.compress_size, size):
                said = f"{name} claims {member.file_size} bytes in {member.compress_size}"
                raise SpikeFileError(f"{path}: damaged, {said}")
            stream, size = stack.enter_context(archive.open(member)), member.file_size
        shape, fortran, dtype = _npy_header(stream)
        _check_array(path, name, shape, dtype, size - stream.tell())
        yield stream, shape, dtype, fortran


def _member(path: Path, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    """Return the member of an archive that holds the recording."""
    members = {
        info.filename.removesuffix(".npy"): info for info in archive.infolist() if info.filename.endswith(".npy")
    }
    shapes = {}
    for name, info in members.items():
        with archive.open(info) as stream:
            shapes[name] = _npy_header(stream)[0]
    named = [name for name in _ARRAY_NAMES if name in shapes]
    solid = [name for name, shape in shapes.items() if len(shape) == 3]
    name = (named or solid or [""])[0]
    if name not in solid or (not named and len(solid) > 1):
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise SpikeFileError(
            f"{path}: expected one array (T, H, W) of zeros and ones, named {' or '.join(_ARRAY_NAMES)} or the only "
            f"one of three dimensions, got {found or 'no array'}"
        )
    return members[name]


def _check_array(path: Path, name: str, shape: tuple[int, ...], dtype: np.dtype, present: int) -> None:
    """Raise unless an array is a recording and as long as its header says."""
    if len(shape) != 3 or dtype.kind not in "buif":
        got = f"{name} {shape} of type {dtype}"
        raise SpikeFileError(f"{path}: expected an array (T, H, W) of zeros and ones, got {got}")
    if 0 in shape:
        raise SpikeFileError(f"{path}: empty recording, {name} is {shape}")
    needed = math.prod(shape) * dtype.itemsize
    if present != needed:
        raise SpikeFileError(f"{path}: truncated, {name} of {shape} takes {needed} bytes, the file holds {present}")


def _npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    with quiet():
        start = io.BytesIO(stream.read(_MOST_HEADER))  # NumPy would read as much as a header claims
        version = np.lib.format.read_magic(start)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        header = read(start)
        stream.seek(start.tell())
        return header
