"""Video output: frames to a film file, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spikekit.arguments import home_path
from spikekit.check import check_picture, check_positive
from spikekit.io.image_bytes import to_bytes
from spikekit.io.video import VideoError
from spikekit.io.whole_file import whole_file

#: Endings of the films that are written, and what FFmpeg calls their formats.
FILM_FORMATS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska", ".gif": "gif"}

# x264 looks hardly ahead, and in one thread, as it holds a dozen frames otherwise
_H264 = {"crf": "17", "preset": "faster", "bf": "0", "rc-lookahead": "2", "threads": "1"}
_BT709, _NARROW, _WIDE = 1, 1, 2  # matrix and primaries of HD; levels 16 to 235, 0 to 255


def check_film(path: str | Path) -> None:
    """Raise at once for what would keep a film from being written: another ending, or PyAV is missing."""
    if Path(path).suffix.lower() not in FILM_FORMATS:
        raise VideoError(f"{path}: expected a film that ends in {', '.join(FILM_FORMATS)}")
    try:
        import av
    except ImportError as error:
        raise VideoError(f"{path}: writing a film needs PyAV, pip install '.[video]'") from error
    if "libx264" not in av.codecs_available and not _is_gif(path):
        raise VideoError(f"{path}: expected a PyAV with libx264, as pip install '.[video]' brings, got none")


def write_video(path: str | Path, frames: Iterable[Tensor], fps: float = 25.0) -> None:
    """Write frames as a film; the folder is made when it is missing.

    Convention:
        ``.mp4``, ``.mov`` and ``.mkv`` are H.264 (CRF 17, 4:2:0, BT.709 at limited levels); odd sides repeat their last
        row or column, as colours are stored two by two. ``.gif`` has 256 colours a frame and counts time in hundredths
        of a second. One frame after the other is asked for, and few are held. The film appears under its name once it
        is complete.

    Args:
        path: where to, ending in one of these.
        frames: (3, H, W) or (H, W) each, all of one size, such as :func:`spikekit.read_video` returns: floating,
            [0, 1], clamped, and rounded to 8 bits; or uint8.
        fps: frames shown in a second.

    Raises:
        VideoError: another ending, no frames, frames of several sizes, or PyAV is missing.
        OSError: the file cannot be written; what was there before, or nothing, is then there.
        TypeError: a frame that is neither floating nor uint8, or an ``fps`` that is not a number.
        ValueError: a frame of another shape, or an ``fps`` that is not above 0.

    Example:
        >>> import tempfile, torch
        >>> from spikekit import read_video
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_video(f"{folder}/dawn.mp4", (torch.full((3, 16, 24), n / 9) for n in range(10)), fps=5)
        ...     film = read_video(f"{folder}/dawn.mp4")
        ...     len(film), film.fps, film.height, film.width
        (10, 5.0, 16, 24)
    """
    path = home_path(path)
    check_film(path)
    check_positive("fps", fps)
    pictures = _pictures(path, frames)
    first = next(pictures, None)
    if first is None:
        raise VideoError(f"{path}: expected at least one frame, got none")
    encode = _gif if _is_gif(path) else _h264
    import av

    with whole_file(path) as file:
        try:
            with av.open(file.name, "w", format=FILM_FORMATS[path.suffix.lower()]) as container:
                encode(container, chain([first], pictures), first.shape, Fraction(float(fps)).limit_denominator(1001))
        except av.FFmpegError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error


def _is_gif(path: str | Path) -> bool:
    return Path(path).suffix.lower() == ".gif"


def _pictures(path: str | Path, frames: Iterable[Tensor]) -> Iterator[np.ndarray]:
    """Frames as (H, W, 3), uint8."""
    size = None
    for frame in frames:
        check_picture("frames", frame, "(3, H, W) or (H, W)", grey=True, floating=frame.dtype != torch.uint8)
        size = size or frame.shape[-2:]
        if frame.shape[-2:] != size:
            got = " x ".join(map(str, frame.shape[-2:]))
            raise VideoError(f"{path}: expected frames of {size[0]} x {size[1]} (H x W) as before, got {got}")
        yield to_bytes(frame.expand(3, *size)).numpy()


def _h264(container: Any, pictures: Iterable[np.ndarray], shape: tuple[int, ...], fps: Fraction) -> None:
    from av import VideoFrame

    height, width = (side + side % 2 for side in shape[:2])
    stream = container.add_stream("libx264", rate=fps, options=_H264)
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    codec = stream.codec_context
    codec.colorspace = codec.color_primaries = codec.color_trc = _BT709
    codec.color_range = _NARROW
    for picture in pictures:
        even = np.pad(picture, [(0, height - len(picture)), (0, width - picture.shape[1]), (0, 0)], "edge")
        rgb = VideoFrame.from_ndarray(even, format="rgb24")
        levels = {"src_color_range": _WIDE, "dst_color_range": _NARROW, "dst_colorspace": _BT709}
        container.mux(stream.encode(rgb.reformat(format="yuv420p", **levels)))
    container.mux(stream.encode(None))


def _gif(container: Any, pictures: Iterable[np.ndarray], shape: tuple[int, ...], fps: Fraction) -> None:
    from av import VideoFrame
    from av.filter import Graph

    # every frame has a palette of its own, so that none waits for the others
    height, width = shape[:2]
    stream = container.add_stream("gif", rate=fps)
    stream.width, stream.height, stream.pix_fmt = width, height, "pal8"
    graph = Graph()
    source = graph.add_buffer(width=width, height=height, format="rgb24", time_base=1 / fps)
    both, palette = graph.add("split"), graph.add("palettegen", "stats_mode=single")
    reduced, sink = graph.add("paletteuse", "new=1"), graph.add("buffersink")
    source.link_to(both)
    both.link_to(reduced, 0, 0)
    both.link_to(palette, 1, 0)
    palette.link_to(reduced, 0, 1)
    reduced.link_to(sink)
    graph.configure()

    def reduce(frame: VideoFrame | None) -> None:
        graph.push(frame)
        with suppress(BlockingIOError, EOFError):  # none is ready, none is left
            while True:
                container.mux(stream.encode(graph.pull()))

    for n, picture in enumerate(pictures):
        frame = VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = n, 1 / fps
        reduce(frame)
    reduce(None)
    container.mux(stream.encode(None))
