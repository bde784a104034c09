"""Video input: folders of pictures and video files as lazy sequences of frames."""

from __future__ import annotations

import operator
import os
import re
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, overload

import torch
from torch import Tensor

from spikekit.arguments import home_path
from spikekit.check import check_size
from spikekit.io.failures import no_pipe, reading
from spikekit.io.images import MOST_PIXELS, picture_size, read_picture

#: Endings of pictures in a folder of frames.
PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm")

#: Endings of video files, read with PyAV.
VIDEO_ENDINGS = (".mp4", ".m4v", ".mkv", ".webm", ".avi", ".mov", ".y4m", ".mpg", ".mpeg", ".ts", ".wmv", ".flv")

# FFmpeg's names of their formats.
_FORMATS = "mov,mp4,matroska,webm,avi,yuv4mpegpipe,mpeg,mpegvideo,mpegts,asf,flv,h264,hevc,m4v"

# Decoded frames that are kept, for short steps back.
_KEPT = 8


class VideoError(ValueError):
    """Unreadable frames; the message is one line and names the file."""


_reading = partial(reading, kind=VideoError)


class VideoFrames(Sequence[Tensor]):
    """Lazy sequence of the frames of a folder of pictures or a video file; see :func:`read_video`.

    Convention:
        A slice is a lazy sequence, too. The object is thread-safe. It can be pickled and used in other processes; each
        opens the files again.

    Attributes:
        height: rows of a frame.
        width: columns of a frame.
        fps: frames per second of a video file; ``None`` for a folder or if unknown.
    """

    def __init__(self, source: _Pictures | _Film, chosen: range) -> None:
        self._source, self._chosen = source, chosen
        self.height, self.width = source.size
        self.fps: float | None = source.fps

    @property
    def names(self) -> list[str]:
        """Names of the files of a folder, or numbers of the frames of a video."""
        return list(map(self._source.name, self._chosen))

    def __len__(self) -> int:
        return len(self._chosen)

    @overload
    def __getitem__(self, index: int) -> Tensor: ...
    @overload
    def __getitem__(self, index: slice) -> VideoFrames: ...
    def __getitem__(self, index: int | slice) -> Tensor | VideoFrames:
        if isinstance(index, slice):
            return VideoFrames(self._source, self._chosen[index])
        return self._source.read(self._chosen[operator.index(index)])

    def __repr__(self) -> str:
        return f"VideoFrames({str(self._source.path)!r}, {len(self)} frames of {self.height} x {self.width})"


def read_video(path: str | Path) -> VideoFrames:
    """Open a folder of pictures or a video file.

    Convention:
        A frame is ``rgb`` (3, H, W), float32, in [0, 1], gamma-encoded as in the file, and upright. Grey, transparent
        and 16-bit pictures are converted as by :func:`spikekit.read_picture`. All frames must have one size.

        The frames of a folder are its PNG, JPEG, BMP, TIFF and PNM files, recognised by their endings, in natural order
        (``f2`` before ``f10``). Folders, hidden files and other files are ignored. A single picture is a film of one
        frame.

        Video files need PyAV (``pip install '.[video]'``). Frames are counted without decoding. Reading forwards, or a
        few frames back, is cheap; further back, decoding starts again at the beginning of the file, so that frame
        numbers are exact.

    Args:
        path: a folder, a picture or a video file.

    Returns:
        The lazy sequence of frames; a slice of it is another.

    Raises:
        VideoError: the file is missing, a folder has no pictures or pictures of several sizes, or PyAV is missing.
            A damaged frame raises it when it is read.

    Example:
        >>> import tempfile
        >>> from spikekit import write_picture
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for n in range(12):
        ...         write_picture(f"{folder}/{n}.png", torch.full((3, 4, 6), n / 255))
        ...     frames = read_video(folder)[1:]
        ...     len(frames), frames.height, frames.width, frames[3:9:4].names, round(frames[-1].max().item() * 255)
        (11, 4, 6, ['4.png', '8.png'], 11)
    """
    source = _open(home_path(path))
    return VideoFrames(source, range(source.count))


def _open(path: Path) -> _Pictures | _Film:
    with _reading(path):
        if path.is_dir():
            return _Pictures(path, _pictures_of(path))
        if not path.exists():
            raise VideoError(f"{path}: no such file or folder")
        no_pipe(path)
    ending = path.suffix.lower()
    if ending in PICTURE_ENDINGS:
        return _Pictures(path, [path])
    if ending in VIDEO_ENDINGS:
        return _Film(path)
    pictures, videos = ", ".join(PICTURE_ENDINGS), ", ".join(VIDEO_ENDINGS)
    raise VideoError(f"{path}: expected a folder of pictures, a picture ({pictures}) or a video ({videos})")


# --- folders ----------------------------------------------------------------------------------------------------------


def natural_order(name: str) -> tuple[list[str | int], str]:
    """Return a sort key that puts ``f2`` before ``f10``: alternating text and numbers, then the name."""
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], name


def _pictures_of(folder: Path) -> list[Path]:
    entries = (entry for entry in folder.iterdir() if not entry.name.startswith("."))
    seen = sorted(entries, key=lambda entry: natural_order(entry.name))
    folders = [entry.name for entry in seen if entry.is_dir()]
    pictures = [entry for entry in seen if entry.suffix.lower() in PICTURE_ENDINGS and entry.name not in folders]
    if not pictures:
        inside = f"folders ({', '.join(folders[:3])}{', ...' if len(folders) > 3 else ''})" if folders else "none"
        raise VideoError(f"{folder}: expected pictures ({', '.join(PICTURE_ENDINGS)}), got {inside}")
    return pictures


class _Pictures:
    """Pictures of a folder, with sizes checked from their headers."""

    fps = None

    def __init__(self, path: Path, files: list[Path]) -> None:
        self.path, self.files, self.count = path, files, len(files)
        # a picture with an unreadable header raises when it is read
        sizes = {file: size for file in files if (size := picture_size(file))}
        if not sizes:
            sizes = {files[0]: tuple(_load(files[0]).shape[1:])}
        self.like, self.size = next(iter(sizes.items()))
        for file, size in sizes.items():
            self._check_size(file, size)

    def _check_size(self, file: Path, size: tuple[int, ...]) -> None:
        check_size(file, size, self.size, f" (H x W) as {self.like}", VideoError)

    def name(self, index: int) -> str:
        return self.files[index].name

    def read(self, index: int) -> Tensor:
        rgb = _load(self.files[index])
        self._check_size(self.files[index], tuple(rgb.shape[1:]))
        return rgb


def _load(file: Path) -> Tensor:
    with _reading(file):
        rgb = read_picture(file)
        low, high = rgb.min().item(), rgb.max().item()
        if not (low >= 0 and high <= 1):
            raise VideoError(f"{file}: expected values in [0, 1], got {low:g} to {high:g}")
        return rgb


# --- video files ------------------------------------------------------------------------------------------------------


_of_parents: list[Any] = []  # decoders inherited by a fork without their threads; must not be closed


class _Film:
    """A video file, decoded sequentially."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            import av  # noqa: F401
        except ImportError as error:
            raise VideoError(f"{path}: reading a video needs PyAV, pip install '.[video]'") from error
        with _reading(path), _container(path) as container:
            stream = next(iter(container.streams.video), None)
            if stream is None or stream.codec_context is None:
                raise VideoError(f"{path}: expected a video stream that can be decoded, got none")
            total = sum(packet.size > 0 and not packet.is_discard for packet in container.demux(stream))
            total = max(total, stream.frames)  # missing frames raise when they are read
            self.turns = _turns(path)
            self.stored = stream.height, stream.width
            self.size = self.stored[:: -1 if self.turns % 2 else 1]
            self.fps = float(stream.average_rate) if stream.average_rate else None
        if not total or 0 in self.size:
            raise VideoError(f"{path}: expected frames, got none")
        if self.size[0] * self.size[1] > MOST_PIXELS:
            raise VideoError(f"{path}: expected at most {MOST_PIXELS} pixels, got {self.size[0]} x {self.size[1]}")
        self.count = total
        self._begin()

    def _begin(self) -> None:
        self._process = os.getpid()
        self._lock = threading.Lock()  # the decoder is not thread-safe; a fork may have copied a held lock
        self._forget()

    def _forget(self) -> None:
        self._decoder: Iterator[Any] | None = None
        self._next = 0
        self._kept: deque[Any] = deque(maxlen=_KEPT)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._begin()

    def name(self, index: int) -> str:
        return f"{index:0{len(str(self.count - 1))}}"

    def read(self, index: int) -> Tensor:
        if self._process != os.getpid():
            _of_parents.append((self._decoder, self._kept))
            self._begin()
        with self._lock:
            return torch.rot90(self._decode(index), self.turns, (-2, -1)).contiguous()

    def _decode(self, index: int) -> Tensor:
        if index < self._next - len(self._kept):
            self._forget()
        if self._decoder is None and self._next <= index:
            self._decoder = _decoded(self.path)
        while self._next <= index:
            try:
                with _reading(self.path, what=f"frame {self._next}: "):
                    frame = next(self._decoder, None)
                    if frame is None:
                        raise VideoError(f"{self.path}: ends after {self._next} of {self.count} frames")
                    if frame.is_corrupt:
                        raise VideoError(f"{self.path}: frame {self._next}: damaged")
                    where, size = f"{self.path}: frame {self._next}", (frame.height, frame.width)
                    check_size(where, size, self.stored, kind=VideoError)
            except VideoError:
                self._forget()  # earlier frames can still be read
                raise
            self._kept.append(frame)
            self._next += 1
        if self._next == self.count:
            self._decoder = None  # closes the file
        with _reading(self.path, what=f"frame {index}: "):
            return _rgb(self._kept[index - self._next])


def _turns(path: Path) -> int:
    """Return the number of counterclockwise quarter turns that make the first frame upright."""
    with suppress(Exception):  # a damaged frame raises when it is read
        return round(next(_decoded(path)).rotation / 90) % 4
    return 0


def _decoded(path: Path) -> Iterator[Any]:
    """Decode a file. Not a method: without a reference cycle, the file is closed as soon as the iterator is freed."""
    with _container(path) as container:
        yield from container.decode(container.streams.video[0])


def _container(path: Path) -> Any:
    """Open a video file, but no playlist, which would make FFmpeg open other files."""
    import av

    return av.open(str(path), options={"format_whitelist": _FORMATS, "protocol_whitelist": "file"})


def _rgb(frame: Any) -> Tensor:
    deep = frame.format.components[0].bits > 8
    pixels = frame.to_ndarray(format="rgb48le" if deep else "rgb24")
    rgb = torch.from_numpy(pixels.astype("float32") / (65535 if deep else 255))
    return rgb.permute(2, 0, 1).contiguous()
