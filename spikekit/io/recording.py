"""A recording with its metadata, from its side-car, its camera or the command line."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spikekit.arguments import UsageError, whole
from spikekit.decoders.calibrated import correct_spikes
from spikekit.io.calibration import ENDING, read_calibration
from spikekit.io.cameras import CAMERAS, Camera, camera
from spikekit.io.files import iter_spikes, read_spikes, spikes_shape
from spikekit.io.formats import SpikeFileError
from spikekit.io.sidecar import find_sidecar
from spikekit.progress import progress
from spikekit.sensor.calibration import Calibration

#: (height, width) of what the field's headerless recordings come from.
USUAL_SIZES = {
    (250, 400): "grey Vidar camera",
    (250, 416): "grey Vidar camera, 16 columns of header",
    (250, 250): "UHSR",
    (1000, 1000): "colour spike camera",
    (1000, 1024): "colour spike camera, PCIe stream",
}


# Pixels that are counted at a time.
_BLOCK = 1 << 24


@dataclass(frozen=True)
class Recording:
    """A file of spikes, read as the camera saw the scene: upright, only pixels, no border.

    Args:
        path: the file.
        frames: how many it holds.
        stored: (H, W) of its frames.
        flip: whether they are stored upside down.
        pattern: Bayer phase of what is read; ``None`` for grey.
        alpha: light of a white pixel per clock, where it is known.
        camera: where it is known.
        calibration: that of the pixels that are read, where it is known.
    """

    path: Path
    frames: int
    stored: tuple[int, int]
    flip: bool = False
    pattern: str | None = None
    alpha: float | None = None
    camera: Camera | None = None
    calibration: Calibration | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of what is read."""
        return self.camera.prepared_size if self.camera else self.stored

    def prepare(self, upright: Tensor) -> Tensor:
        """Leave only the pixels of frames (*, H, W) that are upright already."""
        return self.camera.prepare(upright, flip=False) if self.camera else upright

    def read(self, start: int, frames: int) -> Tensor:
        """Return some frames (T, H, W), uint8."""
        return self.prepare(read_spikes(self.path, *self.stored, flip=self.flip, start=start, frames=frames))

    def frames_from(self, start: int) -> Iterator[Tensor]:
        """Read frames (H, W), uint8, one by one from a place on."""
        return map(self.prepare, iter_spikes(self.path, *self.stored, flip=self.flip, start=start))

    def packed(self, start: int, frames: int) -> Iterator[np.ndarray]:
        """Read frames one by one, as they are stored but upright, for :meth:`unpack`."""
        parts = iter_spikes(self.path, *self.stored, flip=self.flip, start=start, frames=frames, packed=True)
        return (part.numpy() for part in parts)

    def unpack(self, plane: np.ndarray) -> np.ndarray:
        """Return the pixels (H, W) of a packed frame."""
        bits = np.unpackbits(plane, axis=-1, count=self.stored[1], bitorder="little")
        return self.prepare(torch.from_numpy(bits)).numpy()

    def correct(self, raw: Tensor) -> Tensor:
        """Return rates (*, H, W), in spikes a clock, as an ideal sensor would have them."""
        return raw if self.calibration is None else self.calibration.correct(raw, self.pattern)

    def correct_spikes(self, spikes: Tensor) -> Tensor:
        """Return spikes (*, T, H, W) as an ideal sensor would have fired them."""
        return spikes if self.calibration is None else correct_spikes(spikes, self.calibration, self.pattern)

    @property
    def said(self) -> str:
        """What is corrected, in words that follow others."""
        return "" if self.calibration is None else ", pixels corrected by its calibration"

    def counts(self, start: int, frames: int) -> Tensor:
        """Count the spikes of every pixel (H, W) in some frames."""
        height, width = self.stored
        counts = torch.zeros(height, width, dtype=torch.int64)
        chunk = min(max(_BLOCK // (height * width), 1), 255)  # whose sum fits into a byte
        parts = iter_spikes(self.path, height, width, flip=self.flip, start=start, frames=frames, chunk=chunk)
        with progress(what="frames counted", total=frames) as bar:
            for part in parts:
                counts += torch.from_numpy(part.numpy().sum(axis=0, dtype=np.uint8))
                bar.update(len(part))
        return self.prepare(counts)

    def show(self, picture: Tensor, *, known: bool) -> Tensor:
        """Return light as it is shown; the gain of the camera is for light whose white is known, not guessed."""
        if self.camera is None:
            return picture.clamp(0, 1)
        return (self.camera if known else replace(self.camera, gain=1.0)).display(picture)


def white_rate(rates: Tensor) -> float:
    """Return the default for white: the rate that 99.9 per cent of the pixels do not exceed."""
    return float(np.quantile(rates.numpy(), 0.999)) or float(rates.max()) or 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that name a recording."""
    add = parser.add_argument
    add("file", type=Path, metavar="FILE", help="a recording, .dat (8 pixels a byte, no header) or .npz")
    add("--height", type=whole(1), metavar="H", help="rows of a frame; a .dat without side-car or camera needs it")
    add("--width", type=whole(1), metavar="W", help="columns of a frame; likewise")
    add("--flip", action="store_true", help="the frames are stored upside down, as real cameras do")
    add(
        "--camera",
        metavar="NAME",
        help=f"what recorded it: {', '.join(CAMERAS)}, or a .json file of the same form; gives the size, the "
        "flip, the Bayer phase, what to crop, and how pictures are shown",
    )


def add_calibration(parser: argparse.ArgumentParser) -> None:
    """Add the argument that names a calibration."""
    parser.add_argument(
        "--calibration",
        metavar="FILE",
        help="gain, dark rate and defects of the pixels, from spikekit calibrate, to correct pictures by; "
        f"the recording's own, NAME{ENDING} beside it, if not given; none for none",
    )


def open_recording(args: argparse.Namespace) -> Recording:
    """Return the recording that the arguments name, with the metadata of its side-car, camera and calibration.

    Raises:
        UsageError: a headerless file whose size nobody knows, or a camera and a size as well.
        ValueError: a file that cannot be read, or is not of the camera; a calibration of another sensor.
    """
    recording = _described(args)
    asked = getattr(args, "calibration", None)
    file = own_calibration(recording.path) if asked is None else Path(asked)
    if asked == "none" or (asked is None and not file.is_file()):
        return recording
    calibration = read_calibration(file)
    if calibration.size != tuple(recording.size):
        sizes = " x ".join(map(str, recording.size)), " x ".join(map(str, calibration.size))
        raise ValueError(f"{file}: expected {sizes[0]} pixels as {recording.path} has them, got {sizes[1]}")
    return replace(recording, calibration=calibration.flip() if recording.flip else calibration)


def own_calibration(path: Path) -> Path:
    """Return where the calibration of a recording lies."""
    return path.with_suffix(ENDING)


def _described(args: argparse.Namespace) -> Recording:
    path, pattern = args.file, getattr(args, "pattern", None)
    if args.camera is not None:
        if args.flip or not args.height is args.width is None:
            raise UsageError("--camera: it knows --height, --width and --flip, leave them out")
        return _of_camera(path, camera(args.camera), pattern)
    known = find_sidecar(path) if args.height is args.width is None else None  # a damaged one can be done without
    if known is not None:
        size = known.stream["height"], known.stream["width"]
        frames, *_ = spikes_shape(path, *size)
        if frames != known.stream["frames"]:
            raise ValueError(f"{path}: expected {known.stream['frames']} frames as its side-car says, got {frames}")
        settings = known.settings
        return Recording(path, frames, size, args.flip, pattern or settings.get("pattern"), settings.get("alpha"))
    if path.suffix.lower() == ".dat" and path.is_file() and None in (args.height, args.width):
        raise UsageError(_without_size(path))
    frames, *size = spikes_shape(path, args.height, args.width)
    return Recording(path, frames, tuple(size), args.flip, pattern)


def _of_camera(path: Path, known: Camera, pattern: str | None) -> Recording:
    if pattern is not None:
        known = replace(known, pattern=pattern)
    for width in dict.fromkeys((known.width, known.stored_width)):
        try:
            frames, *size = spikes_shape(path, known.height, width)
        except SpikeFileError as error:
            wrong = error
            continue
        return Recording(path, frames, tuple(size), known.flip, known.prepared_pattern, camera=known)
    raise wrong


def _without_size(path: Path) -> str:
    size = path.stat().st_size
    fits = {}
    for (height, width), name in USUAL_SIZES.items():
        frames, rest = divmod(size, -(-height * width // 8))
        if frames and not rest:
            fits[height, width] = f"{height} x {width} ({name}: {frames} frames)"
    sizes = " and ".join(fits.values()) or f"none of {', '.join(f'{h} x {w}' for h, w in USUAL_SIZES)}"
    return (
        f"{path}: a .dat has no header, give --height and --width (of lightning, --data.height and --data.width); "
        f"of the usual sizes (H x W), {sizes} divide{'' if len(fits) > 1 else 's'} its {size} bytes exactly"
    )
