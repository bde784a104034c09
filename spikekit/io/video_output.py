"""Video output: write frames to a film file."""

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
from spikekit.check import check_picture, check_positive, check_size
from spikekit.io.images import to_bytes
from spikekit.io.video import VideoError
from spikekit.io.whole_file import whole_file

#: Endings of films, and FFmpeg's names of their formats.
FILM_FORMATS = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska", ".gif": "gif"}

# little look-ahead and one thread, else x264 holds a dozen frames
_H264 = {"crf": "17", "preset": "faster", "bf": "0", "rc-lookahead": "2", "threads": "1"}
_BT709, _NARROW, _WIDE = 1, 1, 2  # matrix and primaries of HD; levels 16 to 235, 0 to 255


def check_film(path: str | Path) -> None:
    """Raise if a film cannot be written because of its ending or a missing PyAV."""
    if Path(path).suffix.lower() not in FILM_FORMATS:
        raise VideoError(f"{path}: expected a film that ends in {', '.join(FILM_FORMATS)}")
    try:
        import av
    except ImportError as error:
        raise VideoError(f"{path}: writing a film needs PyAV, pip install '.[video]'") from error
    if "libx264" not in av.codecs_available and not _is_gif(path):
        raise VideoError(f"{path}: expected a PyAV with libx264, such as that of pip install '.[video]', got none")


def write_video(path: str | Path, frames: Iterable[Tensor], fps: float = 25.0) -> None:
    """Write frames as a film, and create its folder if needed.

    Convention:
        ``.mp4``, ``.mov`` and ``.mkv`` are H.264 (CRF 17, 4:2:0, BT.709 at limited levels). An odd side repeats its
        last row or column, as 4:2:0 needs even sides. ``.gif`` has 256 colours per frame and frame times in hundredths
        of a second. Frames are consumed one by one. The film appears under its name when it is complete.

    Args:
        path: the file to write, with one of these endings.
        frames: frames (3, H, W) or (H, W) of one size, such as those of :func:`spikekit.read_video`: floating, in
            [0, 1], clamped and rounded to 8 bits; or uint8.
        fps: frames per second.

    Raises:
        VideoError: the ending is unknown, there are no frames or frames of several sizes, or PyAV is missing.
        OSError: the file cannot be written; an existing file is kept.
        TypeError: a frame is neither floating nor uint8, or ``fps`` is not a number.
        ValueError: a frame has another shape, or ``fps`` is not above 0.

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
    """Yield checked frames as (H, W, 3), uint8."""
    size = None
    for frame in frames:
        check_picture("frames", frame, "(3, H, W) or (H, W)", grey=True, floating=frame.dtype != torch.uint8)
        size = size or frame.shape[-2:]
        check_size(path, frame.shape[-2:], size, " (H x W) as the first frame", VideoError)
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

    # one palette per frame, so that no frames are buffered
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
        with suppress(BlockingIOError, EOFError):  # no frame is ready, or none is left
            while True:
                container.mux(stream.encode(graph.pull()))

    for n, picture in enumerate(pictures):
        frame = VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = n, 1 / fps
        reduce(frame)
    reduce(None)
    container.mux(stream.encode(None))
