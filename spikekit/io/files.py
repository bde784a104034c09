"""Recordings on disk: ``.dat``, ``.npy`` and ``.npz``, read and written in bounded memory."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
import torch
from torch import Tensor

from spikekit.arguments import home_path
from spikekit.check import check_index, check_planes, check_size, check_whole
from spikekit.io.formats import (
    SpikeFileError,
    Wanted,
    array_blocks,
    array_shape,
    binary,
    dat_blocks,
    dat_bytes,
    dat_shape,
    reading,
    stored_blocks,
    write_array,
)
from spikekit.io.images import MOST_PIXELS
from spikekit.io.whole_file import whole_file

#: Endings of recording files.
RECORDING_ENDINGS = (".dat", ".npy", ".npz")

# Pixels per write, which bounds the memory of the conversion to bits.
_BLOCK = 1 << 22


def read_spikes(
    path: str | Path,
    height: int | None = None,
    width: int | None = None,
    *,
    flip: bool = False,
    start: int = 0,
    frames: int | None = None,
    packed: bool = False,
) -> Tensor:
    """Read a recording, or some frames of it.

    Convention:
        ``.dat`` has no header. It stores frame after frame, row by row, 8 neighbouring pixels per byte, the leftmost in
        the least significant bit. Frames are padded to whole bytes if 8 does not divide H x W. ``.npy`` holds one array
        (T, H, W) of zeros and ones; ``.npz`` one named ``spk`` or ``spikes``, or else its only 3-D array.

        Real cameras store frames upside down, which no format records. ``flip`` turns them, so that pixel (0, 0) of
        the result is the top left of the scene, where the Bayer phase starts.

        Only the requested frames of a ``.dat`` are read; an array in Fortran order is always read whole.

    Args:
        path: a file ending in ``.dat``, ``.npy`` or ``.npz``.
        height: rows of a frame; required for ``.dat``, compared with the file for other formats.
        width: columns of a frame; required in the same cases.
        flip: turn the stored frames upside down.
        start: the first frame to read.
        frames: number of frames; default: up to the end.
        packed: keep 8 pixels per byte, in the layout of :func:`spikekit.pack_spikes`.

    Returns:
        ``spikes`` of shape (T, H, W), uint8, zeros and ones; (T, H, ceil(W / 8)) if ``packed``.

    Raises:
        SpikeFileError: the file is missing, not a recording, damaged, truncated, of another size, or too short.
        TypeError: a size or a number of frames is not a whole number.

    Example:
        >>> import tempfile
        >>> spikes = (torch.rand(5, 3, 7) < 0.3).to(torch.uint8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_spikes(f"{folder}/clip.dat", spikes)
        ...     read_spikes(f"{folder}/clip.dat", 3, 7, start=2).equal(spikes[2:])
        True
    """
    (whole,) = _open(path, height, width, flip, start, frames, None, packed)
    return torch.from_numpy(whole)


def iter_spikes(
    path: str | Path,
    height: int | None = None,
    width: int | None = None,
    *,
    flip: bool = False,
    start: int = 0,
    frames: int | None = None,
    chunk: int | None = None,
    packed: bool = False,
) -> Iterator[Tensor]:
    """Read a recording frame by frame, or in chunks of frames, in bounded memory.

    Convention:
        Formats as in :func:`read_spikes`. Everything except the frames themselves is checked at the call, not at the
        first frame.

    Args:
        path: a file ending in ``.dat``, ``.npy`` or ``.npz``.
        height: rows of a frame; required for ``.dat``, compared with the file for other formats.
        width: columns of a frame; required in the same cases.
        flip: turn the stored frames upside down.
        start: the first frame to read.
        frames: number of frames; default: up to the end.
        chunk: frames per chunk; the last one may be shorter. Default: single frames.
        packed: keep 8 pixels per byte, in the layout of :func:`spikekit.pack_spikes`.

    Returns:
        An iterator over frames (H, W) or chunks (chunk, H, W), uint8, zeros and ones; if ``packed``, over
        (H, ceil(W / 8)) or (chunk, H, ceil(W / 8)).

    Raises:
        SpikeFileError: as :func:`read_spikes`.
        TypeError: as :func:`read_spikes`.
        ValueError: ``chunk`` is not a whole number >= 1.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_spikes(f"{folder}/clip.dat", torch.ones(5, 3, 7))
        ...     [tuple(part.shape) for part in iter_spikes(f"{folder}/clip.dat", 3, 7, chunk=2)]
        [(2, 3, 7), (2, 3, 7), (1, 3, 7)]
    """
    if chunk is None:
        return (torch.from_numpy(one[0]) for one in _open(path, height, width, flip, start, frames, 1, packed))
    chunk = check_whole("chunk", chunk)
    return map(torch.from_numpy, _open(path, height, width, flip, start, frames, chunk, packed))


def spikes_shape(path: str | Path, height: int | None = None, width: int | None = None) -> tuple[int, int, int]:
    """Return (T, H, W) of a recording without reading its frames.

    Args:
        path: a file ending in ``.dat``, ``.npy`` or ``.npz``.
        height: rows of a frame; required for ``.dat``, compared with the file for other formats.
        width: columns of a frame; required in the same cases.

    Returns:
        Numbers of frames, rows and columns.

    Raises:
        SpikeFileError: as :func:`read_spikes`.
        TypeError: as :func:`read_spikes`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_spikes(f"{folder}/clip.npz", torch.ones(5, 3, 7))
        ...     spikes_shape(f"{folder}/clip.npz")
        (5, 3, 7)
    """
    path = home_path(path)
    height = None if height is None else check_index("height", height)
    width = None if width is None else check_index("width", width)
    with reading(path):
        if path.is_dir():
            raise SpikeFileError(f"{path}: expected a recording, got a folder")
        if not path.is_file():
            raise SpikeFileError(f"{path}: no such file")
        size = path.stat().st_size
    if size == 0:
        raise SpikeFileError(f"{path}: empty file")
    shape = dat_shape(path, size, height, width) if _check_suffix(path) == ".dat" else array_shape(path, height, width)
    if shape[1] * shape[2] > MOST_PIXELS:  # a small compressed file could fill the memory
        raise SpikeFileError(f"{path}: expected frames of at most {MOST_PIXELS} pixels, got {shape[1]} x {shape[2]}")
    return shape


def write_spikes(path: str | Path, spikes: Tensor | Iterable[Tensor], *, flip: bool = False) -> None:
    """Write a recording, and create its folder if needed.

    Convention:
        Formats as in :func:`read_spikes`; the array of an ``.npz`` is called ``spk``. The file appears under its name
        when it is complete, so an interrupted run leaves no partial recording.

        A recording that does not fit in memory can be passed in chunks of any length; one chunk is held at a time. A
        NumPy file stores its length before its frames, so packed frames are buffered on disk until the last one.

    Args:
        path: the file to write, ending in ``.dat``, ``.npy`` or ``.npz``.
        spikes: (T, H, W), zeros and ones, any real dtype; or an iterable of such chunks or of frames (H, W).
        flip: store the frames upside down, as real cameras do.

    Raises:
        SpikeFileError: the name has another ending.
        OSError: the file cannot be written; an existing file is kept.
        TypeError: ``spikes`` is neither a tensor of real numbers nor an iterable of such tensors.
        ValueError: ``spikes`` has another shape, is empty, has frames of several sizes, or values other than 0 and 1.

    Example:
        Write a simulated recording chunk by chunk:

        >>> import tempfile
        >>> from spikekit import spike_integrate_fire
        >>> def expose(lights):
        ...     charge = None
        ...     for light in lights:
        ...         spikes, charge = spike_integrate_fire(light, charge=charge)
        ...         yield spikes
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_spikes(f"{folder}/long.dat", expose(torch.rand(100, 3, 7) for _ in range(9)))
        ...     spikes_shape(f"{folder}/long.dat", 3, 7)
        (900, 3, 7)
    """
    path = home_path(path)
    suffix = _check_suffix(path)
    with whole_file(path) as file:
        if suffix == ".dat":
            _write_bits(file, spikes, flip)
            return
        # the header of an array holds the number of frames
        with tempfile.TemporaryFile(dir=path.parent) as bits:
            frames, height, width = _write_bits(bits, spikes, flip)
            stored = stored_blocks(bits, Wanted(path, height, width, 0, frames, 1))
            write_array(file, suffix, (frames, height, width), stored)


def _write_bits(file: IO[bytes], spikes: Tensor | Iterable[Tensor], flip: bool) -> tuple[int, int, int]:
    """Write frames in the layout of a ``.dat``; return (T, H, W)."""
    written = 0
    for chunk in _chunks(spikes):
        height, width = chunk.shape[1:]
        for block in chunk.split(max(1, _BLOCK // (height * width))):
            block = block.float() if block.dtype is torch.bfloat16 else block  # NumPy has no bfloat16
            bits = binary(block.cpu().resolve_neg().numpy(), "spikes", written, ValueError)[:, :: -1 if flip else 1]
            file.write(dat_bytes(bits))
            written += len(bits)
    file.flush()
    return written, height, width


def _chunks(spikes: Tensor | Iterable[Tensor]) -> Iterator[Tensor]:
    """Yield checked chunks (T, H, W) of one frame size; raise if there are none."""
    if isinstance(spikes, Tensor):
        check_planes("spikes", spikes, 3, "(T, H, W)")
        spikes = [spikes]
    elif not isinstance(spikes, Iterable):
        raise TypeError(f"spikes: expected a tensor of shape (T, H, W), or chunks of it, got {type(spikes).__name__}")
    size = None
    for chunk in spikes:
        check_planes("spikes", chunk, 2, "(T, H, W)")
        if chunk.ndim > 3 or 0 in chunk.shape:
            raise ValueError(f"spikes: expected (T, H, W), got {tuple(chunk.shape)}")
        size = size or chunk.shape[-2:]
        check_size("spikes", chunk.shape[-2:], size, " as the first frame")
        yield chunk.detach().reshape(-1, *size)
    if size is None:
        raise ValueError("spikes: expected at least one chunk (T, H, W), got none")


def _open(
    path: str | Path,
    height: int | None,
    width: int | None,
    flip: bool,
    start: int,
    frames: int | None,
    chunk: int | None,
    packed: bool,
) -> Iterator[np.ndarray]:
    """Check everything except the frames themselves; return an iterator over blocks of ``chunk`` or all frames."""
    path = home_path(path)
    total, height, width = spikes_shape(path, height, width)
    start = check_index("start", start)
    frames = total - start if frames is None else check_index("frames", frames)
    if start < 0 or frames < 1 or start + frames > total:
        raise SpikeFileError(f"{path}: expected frames within 0 .. {total - 1}, got {frames} from frame {start} on")
    read = dat_blocks if path.suffix.lower() == ".dat" else array_blocks
    return read(Wanted(path, height, width, start, frames, chunk or frames, flip, packed))


def _check_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in RECORDING_ENDINGS:
        expected = f"expected a recording that ends in {', '.join(RECORDING_ENDINGS)}"
        raise SpikeFileError(f"{path}: {expected}, got {suffix or 'no ending'}")
    return suffix
