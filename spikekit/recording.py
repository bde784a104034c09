"""A recording with its metadata, from its side-car, its camera or the arguments."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spikekit.arguments import UsageError, home_path
from spikekit.calibration.calibration import ENDING, Calibration, read_calibration
from spikekit.calibration.defects import find_outliers
from spikekit.check import check_size
from spikekit.color.cfa import GREY, cfa_pattern
from spikekit.io.cameras import Camera, usual_sizes
from spikekit.io.cameras import camera as load_camera
from spikekit.io.files import iter_spikes, spikes_shape
from spikekit.io.formats import SpikeFileError
from spikekit.io.sidecar import find_sidecar
from spikekit.progress import progress

# Pixels per chunk.
_BLOCK = 1 << 24

# parts of a recording that white and noise are measured on, and least frames of a part of several
_PARTS, _LEAST_PART = 4, 200
# short parts for the white level, their least frames, and spikes of a white pixel in them
_SHORT_PARTS, _SHORT, _SPIKES = 8, 41, 24


@dataclass(frozen=True)
class Recording:
    """A file of spikes, read as upright frames without border pixels."""

    path: Path
    frames: int
    stored: tuple[int, int]  # (H, W) of the stored frames
    flip: bool = False  # frames are stored upside down
    pattern: str | None = None  # Bayer phase of the frames as read, or "grey"; None if unknown
    alpha: float | None = None  # light of a white pixel per clock, if known
    camera: Camera | None = None
    calibration: Calibration | None = None  # of the frames as read
    ideal: bool = False  # declared free of noise
    note: str = ""  # a hint for the user, such as a likely wrong orientation

    @property
    def bayer(self) -> str | None:
        """Bayer phase of the frames as read; ``None`` if they are grey or it is unknown."""
        return None if self.pattern == GREY else self.pattern

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the frames as read."""
        return self.camera.prepared_size if self.camera else self.stored

    def prepare(self, upright: Tensor) -> Tensor:
        """Crop upright frames (*, H, W) to the pixels of the sensor."""
        return self.camera.prepare(upright, flip=False) if self.camera else upright

    def frames_from(self, start: int) -> Iterator[Tensor]:
        """Iterate over the frames from ``start`` on, each (H, W), uint8."""
        return map(self.prepare, iter_spikes(self.path, *self.stored, flip=self.flip, start=start))

    def packed(self, start: int, frames: int) -> Iterator[np.ndarray]:
        """Iterate over packed upright frames, for :meth:`unpack`."""
        parts = iter_spikes(self.path, *self.stored, flip=self.flip, start=start, frames=frames, packed=True)
        return (part.numpy() for part in parts)

    def unpack(self, plane: np.ndarray) -> np.ndarray:
        """Return the pixels (H, W) of a packed frame."""
        bits = np.unpackbits(plane, axis=-1, count=self.stored[1], bitorder="little")
        return self.prepare(torch.from_numpy(bits)).numpy()

    @cached_property
    def looks(self) -> tuple[Tensor, int]:
        """Corrected rates (P, H, W) of parts evenly spread over the recording, and frames of a part."""
        parts = min(max(self.frames // _LEAST_PART, 1), _PARTS)
        room = self.frames if parts == 1 else 9 * self.frames // 10  # across gaps, counts are rounded independently
        frames = min(room // parts, 2 * _LEAST_PART)
        starts = np.linspace(0, self.frames - frames, parts).astype(int).tolist()
        return self.correct(torch.stack([self.counts(start, frames) for start in starts]) / frames), frames

    @cached_property
    def white(self) -> float:
        """Default white level: that of the mean or, if higher, of a short part, which blurs moving highlights less."""
        white = white_rate(self.looks[0].mean(0), self.bayer)
        frames = min(max(math.ceil(_SPIKES / white), _SHORT), self.frames)
        starts = np.linspace(0, self.frames - frames, min(self.frames // frames, _SHORT_PARTS)).astype(int).tolist()
        parts = (self.correct(self.counts(start, frames) / frames) for start in starts)
        return max(white, *(white_rate(part, self.bayer) - 0.5 / frames for part in parts))  # counts are rounded up

    def correct(self, raw: Tensor) -> Tensor:
        """Return the rates (*, H, W), in spikes per clock, that an ideal sensor would give."""
        return raw if self.calibration is None else self.calibration.correct(raw, self.bayer)

    @property
    def said(self) -> str:
        """A phrase about the correction, to append to a report."""
        return "" if self.calibration is None else ", pixels corrected by its calibration"

    def chunks(self, start: int, frames: int, what: str) -> Iterator[Tensor]:
        """Iterate over chunks (T_i, H, W), uint8, of up to 255 frames, with a progress bar."""
        height, width = self.stored
        chunk = min(max(_BLOCK // (height * width), 1), 255)
        parts = iter_spikes(self.path, height, width, flip=self.flip, start=start, frames=frames, chunk=chunk)
        with progress(what=what, total=frames) as bar:
            for part in parts:
                yield self.prepare(part)
                bar.update(len(part))

    def counts(self, start: int, frames: int) -> Tensor:
        """Return the number of spikes of every pixel, (H, W), in some frames."""
        counts = torch.zeros(self.size, dtype=torch.int64)
        for part in self.chunks(start, frames, "frames counted"):
            counts += torch.from_numpy(part.numpy().sum(axis=0, dtype=np.uint8))  # a chunk's sum fits into a byte
        return counts

    def show(self, picture: Tensor, *, known: bool) -> Tensor:
        """Return light scaled for display; the camera's gain applies only if the white level is ``known``."""
        if self.camera is None:
            return picture.clamp(0, 1)
        return (self.camera if known else replace(self.camera, gain=1.0)).display(picture)


def white_rate(rates: Tensor, pattern: str | None = None) -> float:
    """Return the default white level: the 99.9th percentile of the rates (H, W), without those of hot pixels."""
    _, hot, _ = find_outliers(rates, 1, pattern)
    return float(np.quantile(rates[~hot].numpy(), 0.999)) or float(rates[~hot].max()) or 1.0


def open_recording(
    path: str | Path,
    *,
    height: int | None = None,
    width: int | None = None,
    flip: bool = False,
    pattern: str | None = None,
    camera: str | Path | None = None,
    calibration: str | Path | None = None,
) -> Recording:
    """Open a recording with its metadata. The arguments are those of the commands.

    Raises:
        UsageError: the size of a headerless file is unknown, a camera and a size are both given, or the pattern is
            unknown.
        ValueError: the file cannot be read, or does not match the camera or the calibration.

    Example:
        >>> import tempfile
        >>> from spikekit import write_spikes
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_spikes(f"{folder}/street.dat", torch.ones(5, 250, 400))
        ...     street = open_recording(f"{folder}/street.dat", height=250, width=400)
        >>> street.frames, street.size, street.note
        (5, (250, 400), '250 x 400 is the size of the camera vidar, which stores frames upside down: --flip turns them')
    """
    recording = _described(home_path(path), height, width, flip, pattern, camera)
    file = own_calibration(recording.path) if calibration is None else home_path(calibration)
    if str(calibration) == "none":
        return replace(recording, ideal=True)
    if calibration is None and not file.is_file():
        return recording
    known = read_calibration(file)
    if known.size != recording.size == known.size[::-1]:
        (height, width), (rows, columns) = known.size, recording.size
        expected = f"expected {height} x {width} pixels, the size of {file}, got {rows} x {columns}"
        raise ValueError(f"{recording.path}: {expected}; height and width may be swapped")
    check_size(file, known.size, recording.size, f" pixels, the size of {recording.path}")
    return replace(recording, calibration=known.flip() if recording.flip else known)


def own_calibration(path: Path) -> Path:
    """Return the path of a recording's own calibration."""
    return path.with_suffix(ENDING)


def _described(
    path: Path, height: int | None, width: int | None, flip: bool, pattern: str | None, camera: str | Path | None
) -> Recording:
    try:
        pattern = None if pattern is None else cfa_pattern(pattern)
    except (TypeError, ValueError) as error:
        raise UsageError(f"--{error}") from error
    if camera is not None:
        if flip or not height is width is None:
            raise UsageError("--camera: it sets --height, --width and --flip; remove them")
        return _of_camera(path, load_camera(camera), pattern)
    known = find_sidecar(path) if height is width is None else None  # a damaged one does not matter with a size
    if known is not None:
        size = known.stream["height"], known.stream["width"]
        frames, *_ = spikes_shape(path, *size)
        if frames != known.stream["frames"]:
            raise ValueError(f"{path}: expected {known.stream['frames']} frames, as in its side-car, got {frames}")
        settings = known.settings
        return Recording(path, frames, size, flip, pattern or settings.get("pattern"), settings.get("alpha"))
    if path.suffix.lower() == ".dat" and path.is_file() and None in (height, width):
        raise UsageError(_without_size(path))
    frames, *size = spikes_shape(path, height, width)
    note = "" if flip else _upside_down(*size)
    if height is width is None and max(size) > 3 * min(size) and max(frames, size[0]) < 2 * min(frames, size[0]):
        note = f"read as {frames} frames of {size[0]} x {size[1]}; if the array is (H, W, T), transpose it to (T, H, W)"
    return Recording(path, frames, tuple(size), flip, pattern, note=note)


def _of_camera(path: Path, known: Camera, pattern: str | None) -> Recording:
    if pattern is not None:
        known = replace(known, pattern=None if pattern == GREY else pattern)
    for width in dict.fromkeys((known.width, known.stored_width)):
        try:
            frames, *size = spikes_shape(path, known.height, width)
        except SpikeFileError as error:
            wrong = error
            continue
        return Recording(path, frames, tuple(size), known.flip, known.prepared_pattern or GREY, camera=known)
    raise wrong


def _upside_down(height: int, width: int) -> str:
    """Return a hint if frames of this size are usually stored upside down, else an empty string."""
    names = [known.name for known in usual_sizes().get((height, width), []) if known.flip]
    said = f"{height} x {width} is the size of the camera {' and '.join(names)}"
    return f"{said}, which stores frames upside down: --flip turns them" if names else ""


def _without_size(path: Path) -> str:
    size, usual = path.stat().st_size, usual_sizes()
    fits = {}
    for (height, width), known in usual.items():
        frames, rest = divmod(size, -(-height * width // 8))
        if frames and not rest:
            fits[height, width] = f"{height} x {width} ({' or '.join(one.name for one in known)}: {frames} frames)"
    sizes = " and ".join(fits.values()) or f"none of {', '.join(f'{h} x {w}' for h, w in usual)}"
    return (
        f"{path}: a .dat has no header, give --height and --width, or --camera; of the sizes (H x W) of known cameras, "
        f"{sizes} divide{'' if len(fits) > 1 else 's'} its {size} bytes exactly"
    )
