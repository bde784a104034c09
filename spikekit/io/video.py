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
from spikekit.check import check_whole
from spikekit.io.failures import no_pipe, reading
from spikekit.io.images import MOST_PIXELS, picture_size, read_picture

#: Endings of pictures, which may stand for frames.
PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm")

#: Endings of video files, which PyAV reads.
VIDEO_ENDINGS = (".mp4", ".m4v", ".mkv", ".webm", ".avi", ".mov", ".y4m", ".mpg", ".mpeg", ".ts", ".wmv", ".flv")

# What FFmpeg calls the formats of such files.
_FORMATS = "mov,mp4,matroska,webm,avi,yuv4mpegpipe,mpeg,mpegvideo,mpegts,asf,flv,h264,hevc,m4v"

# Frames of a video file that stay decoded, so that a step back needs no second start.
_KEPT = 8


class VideoError(ValueError):
    """Frames that cannot be read; the message is one line and names the file."""


_reading = partial(reading, kind=VideoError)


class VideoFrames(Sequence[Tensor]):
    """The frames of a folder of pictures or of a video file, each read when it is asked for; see :func:`read_video`.

    Convention:
        A slice is again a lazy sequence. Threads can share the object, which decodes for one after the other. It can be
        pickled and used in other processes; each opens the files for itself.

    Attributes:
        height: rows of a frame.
        width: columns of a frame.
        fps: frames a second, of a video file that says so; ``None`` for a folder.
    """

    def __init__(self, source: _Pictures | _Film, chosen: range) -> None:
        self._source, self._chosen = source, chosen
        self.height, self.width = source.size
        self.fps: float | None = source.fps

    @property
    def names(self) -> list[str]:
        """Names of the files in a folder, or numbers of the frames in a video file."""
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


def read_video(path: str | Path, *, start: int = 0, count: int | None = None) -> VideoFrames:
    """Open a folder of pictures or a video file.

    Convention:
        A frame is ``rgb`` (3, H, W), float32, in [0, 1], gamma-encoded as it was stored and upright as the file says.
        Grey pictures get three equal channels, alpha is laid over white (an opaque one changes nothing), 16-bit files
        keep their depth; see :func:`spikekit.read_picture`. All frames have the size of the first.

        In a folder the pictures are the PNG, JPEG, BMP, TIFF and PNM files, told by their endings, in natural order
        (``f2`` before ``f10``); folders, hidden files and files with other endings are left out. A single picture is a
        film of one frame.

        Video files need PyAV (``pip install '.[video]'``). Frames are counted without decoding them. Reading on
        is cheap, a few frames back too; further back the file is decoded from its start again, so that frame n is
        always the same one.

    Args:
        path: a folder, a picture or a video file.
        start: the first frame.
        count: how many; up to the end when not given.

    Returns:
        The frames, none of which is read yet.

    Raises:
        VideoError: no such file, no pictures in it, pictures of several sizes, PyAV is missing, or there are fewer
            frames. A frame that is damaged raises it when it is asked for.
        TypeError: ``start`` is not a whole number.
        ValueError: ``count`` is not a whole number, 1 or more.

    Example:
        >>> import tempfile
        >>> from spikekit import write_picture
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for n in range(12):
        ...         write_picture(f"{folder}/{n}.png", torch.full((3, 4, 6), n / 255))
        ...     frames = read_video(folder, start=1)
        ...     len(frames), frames.height, frames.width, frames[3:9:4].names, round(frames[-1].max().item() * 255)
        (11, 4, 6, ['4.png', '8.png'], 11)
    """
    start = operator.index(start)
    source = _open(home_path(path))
    stop = source.count if count is None else start + check_whole("count", count)
    if not 0 <= start < source.count or stop > source.count:
        wanted = f"frame {start}" if count is None else f"{count} frames from frame {start} on"
        raise VideoError(f"{path}: expected {wanted}, got {source.count} frame{'s' * (source.count != 1)}")
    return VideoFrames(source, range(start, stop))


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
    raise VideoError(
        f"{path}: expected a folder of pictures, a picture ({', '.join(PICTURE_ENDINGS)}) or a video "
        f"({', '.join(VIDEO_ENDINGS)})"
    )


# --- folders ----------------------------------------------------------------------------------------------------------


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Sort digits by their number: text and numbers take turns, so that like is compared with like."""
    parts = re.split(r"([0-9]+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def _pictures_of(folder: Path) -> list[Path]:
    seen = sorted((entry for entry in folder.iterdir() if not entry.name.startswith(".")), key=_natural)
    folders = [entry.name for entry in seen if entry.is_dir()]
    pictures = [entry for entry in seen if entry.suffix.lower() in PICTURE_ENDINGS and entry.name not in folders]
    if not pictures:
        inside = f"folders ({', '.join(folders[:3])}{', ...' if len(folders) > 3 else ''})" if folders else "none"
        raise VideoError(f"{folder}: expected pictures ({', '.join(PICTURE_ENDINGS)}), got {inside}")
    return pictures


class _Pictures:
    """Pictures in a folder; their sizes are compared from the headers, before any of them is read."""

    fps = None

    def __init__(self, path: Path, files: list[Path]) -> None:
        self.path, self.files, self.count = path, files, len(files)
        # what has no header that can be read is damaged, and raises when it is its turn
        sizes = {file: size for file in files if (size := picture_size(file))}
        if not sizes:
            sizes = {files[0]: tuple(_load(files[0]).shape[1:])}
        self.like, self.size = next(iter(sizes.items()))
        for file, size in sizes.items():
            self._check_size(file, size)

    def _check_size(self, file: Path, size: tuple[int, ...]) -> None:
        if size != self.size:
            (h, w), (height, width) = size, self.size
            raise VideoError(f"{file}: expected {height} x {width} (H x W) as in {self.like}, got {h} x {w}")

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


_of_parents: list[Any] = []  # decoders whose threads a fork has not got: they are let be


class _Film:
    """A video file, decoded on from the frame that was asked for last."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            import av  # noqa: F401
        except ImportError as error:
            raise VideoError(f"{path}: reading a video needs PyAV, pip install '.[video]'") from error
        with _reading(path), _container(path) as container:
            stream = next(iter(container.streams.video), None)
            if stream is None or stream.codec_context is None:
                raise VideoError(f"{path}: expected a video, got none that can be decoded")
            total = sum(packet.size > 0 and not packet.is_discard for packet in container.demux(stream))
            total = max(total, stream.frames)  # what the header promises and the file lacks is told when it is reached
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
        self._lock = threading.Lock()  # of a decoder that two threads would crash, and that a fork may leave held
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
                    if (frame.height, frame.width) != self.stored:
                        sizes = " x ".join(map(str, self.stored)), f"{frame.height} x {frame.width}"
                        raise VideoError(f"{self.path}: frame {self._next}: expected {sizes[0]}, got {sizes[1]}")
            except VideoError:
                self._forget()  # whoever asks for an earlier frame again gets it
                raise
            self._kept.append(frame)
            self._next += 1
        if self._next == self.count:
            self._decoder = None  # whose file is closed with it
        with _reading(self.path, what=f"frame {index}: "):
            return _rgb(self._kept[index - self._next])


def _turns(path: Path) -> int:
    """Return by how many quarter turns, counterclockwise, the first frame has to be turned to be upright."""
    with suppress(Exception):  # a frame that is damaged says so when it is asked for
        return round(next(_decoded(path)).rotation / 90) % 4
    return 0


def _decoded(path: Path) -> Iterator[Any]:
    """Decode a file; no method, so that the file is closed when the frames are let go, without a garbage collector."""
    with _container(path) as container:
        yield from container.decode(container.streams.video[0])


def _container(path: Path) -> Any:
    """Open a video file, and nothing that it names: to FFmpeg, a list of other files is a video as well."""
    import av

    return av.open(str(path), options={"format_whitelist": _FORMATS, "protocol_whitelist": "file"})


def _rgb(frame: Any) -> Tensor:
    deep = frame.format.components[0].bits > 8
    pixels = frame.to_ndarray(format="rgb48le" if deep else "rgb24")
    rgb = torch.from_numpy(pixels.astype("float32") / (65535 if deep else 255))
    return rgb.permute(2, 0, 1).contiguous()
