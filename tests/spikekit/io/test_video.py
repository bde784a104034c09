"""Folders of pictures and films: lazy reading, order, colours, writing, and one-line errors."""

import pickle
import re
import struct
import subprocess
import sys
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction

import numpy as np
import pytest
import torch
from PIL import Image

from spikekit import read_video, write_picture, write_video
from spikekit.io.video import VideoError

SIZE = (48, 64)


def frame(n, height=6, width=8):
    """A picture that encodes its number."""
    return torch.full((3, height, width), n / 255)


def folder_of(path, names, **size):
    for n, name in enumerate(names):
        write_picture(path / name, frame(n, **size))
    return path


def number(rgb):
    return round(rgb.mean().item() * 255)


def fails(path, *words):
    """Check for a one-line error that names the file and contains the words."""
    with pytest.raises(VideoError) as info:
        list(read_video(path))
    said = str(info.value)
    assert isinstance(info.value, ValueError)
    assert "\n" not in said
    for word in (str(path), *map(str, words)):
        assert word in said, said
    return said


# --- folders ----------------------------------------------------------------------------------------------------------


def test_a_folder_is_a_lazy_sequence(tmp_path):
    frames = read_video(folder_of(tmp_path, [f"f{n}.png" for n in range(12)]))
    assert isinstance(frames, Sequence)
    assert (len(frames), frames.height, frames.width, frames.fps) == (12, 6, 8, None)
    assert frames.names == [f"f{n}.png" for n in range(12)]
    part = frames[2:9:3]
    assert frames[10].dtype == torch.float32
    assert frames[10].shape == (3, 6, 8)
    assert part.names == ["f2.png", "f5.png", "f8.png"]
    assert [number(rgb) for rgb in part] == [2, 5, 8]
    assert [number(rgb) for rgb in frames[::-1][:2]] == [11, 10]
    for wrong in (12, -13):
        with pytest.raises(IndexError):
            frames[wrong]
    only = read_video(tmp_path / "f7.png")
    assert (len(only), only.names, number(only[0])) == (1, ["f7.png"], 7)


def test_natural_order_and_ignored_files(tmp_path):
    names = ["a1b2.png", "a1b10.bmp", "a2.JPG", "a010.tif", "a11.jpeg", "b.png"]
    folder_of(tmp_path, names)
    folder_of(tmp_path, [".hidden.png", "deeper/a0.png"])
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "notes.txt").write_text("no picture")
    frames = read_video(tmp_path)
    assert frames.names == names
    assert [number(rgb) for rgb in frames] == list(range(6))


def test_mixed_sizes_name_both(tmp_path):
    folder_of(tmp_path, ["0.png", "1.png"])
    write_picture(tmp_path / "2.png", frame(2, 6, 9))
    said = fails(tmp_path, tmp_path / "2.png", "6 x 9", "6 x 8", tmp_path / "0.png")
    assert said.startswith(str(tmp_path / "2.png"))


def test_a_damaged_picture_in_the_middle(tmp_path):
    """It raises when it is read, like a link without target; the others can be read."""
    for n in range(4):
        write_picture(tmp_path / f"{n}.png", torch.rand(3, 40, 50))
    whole = (tmp_path / "2.png").read_bytes()
    for damaged in (whole[: len(whole) // 2], None):
        (tmp_path / "2.png").unlink()
        if damaged is None:
            (tmp_path / "2.png").symlink_to(tmp_path / "gone.png")
        else:
            (tmp_path / "2.png").write_bytes(damaged)
        frames = read_video(tmp_path)
        with pytest.raises(VideoError, match=re.escape(str(tmp_path / "2.png"))) as info:
            frames[2]
        assert "\n" not in str(info.value)
        assert str(info.value).count("2.png:") == 1
        assert frames[3].shape == (3, 40, 50)


def test_invalid_films_are_rejected(tmp_path, monkeypatch):
    fails(tmp_path / "nothing", "no such file")
    fails(tmp_path, "expected pictures", "none")
    folder_of(tmp_path, ["walk/0.png", "city/0.png"])
    fails(tmp_path, "folders (city, walk)")
    for value in (-0.1, 1.5, float("nan")):  # beyond black and white
        Image.fromarray(np.full((6, 8), value, np.float32)).save(tmp_path / "a.tif")
        fails(tmp_path / "a.tif", "[0, 1]")
    for name, said in (("notes.txt", "a folder of pictures"), ("bad.png", "not a readable picture"), ("bad.mp4", "")):
        (tmp_path / name).write_text("no film")
        fails(tmp_path / name, said)
    fails(tmp_path / "notes.txt" / "deeper")
    monkeypatch.setitem(sys.modules, "av", None)
    fails(tmp_path / "bad.mp4", "pip install '.[video]'")


# --- video files ------------------------------------------------------------------------------------------------------


def write_film(path, frames=12, codec="libx264", pixels="yuv420p", level=20, **options):
    """Write a film whose frame n is grey with value ``level * n``."""
    av = pytest.importorskip("av")
    muxing = {"movflags": "faststart"} if path.suffix == ".mp4" else {}  # the index before the frames
    with av.open(str(path), "w", options=muxing) as container:
        stream = container.add_stream(codec, rate=25)
        (stream.height, stream.width), stream.pix_fmt, stream.options = SIZE, pixels, options
        stream.bit_rate = 10_000_000
        for n in range(frames):
            grey = np.full((*SIZE, 3), level * n, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def level_of(rgb):
    return rgb.mean().item() * 255 / 20


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("a.mp4", "libx264", {"bf": "3", "g": "5"}),
        ("a.mkv", "ffv1", {}),
        ("a.avi", "mpeg4", {}),
        ("a.mov", "libx264", {}),
        ("a.webm", "libvpx", {"auto-alt-ref": "1", "lag-in-frames": "16"}),
        ("a.y4m", "wrapped_avframe", {}),
    ],
)
def test_frames_of_a_video_file_are_read(tmp_path, name, codec, options):
    """Frames do not depend on the order of reading, on slices, or on pickling."""
    frames = read_video(write_film(tmp_path / name, codec=codec, **options))
    assert (len(frames), frames.height, frames.width, frames.fps) == (12, *SIZE, 25)
    assert (frames.names[0], frames.names[11]) == ("00", "11")
    in_order = list(frames)
    for n, rgb in enumerate(in_order):
        assert rgb.shape == (3, *SIZE)
        assert rgb.dtype == torch.float32
        assert level_of(rgb) == pytest.approx(n, abs=0.2)
    for n in (5, 4, 9, 9, 0, 11, 2):
        assert frames[n].equal(in_order[n]), n
    part = pickle.loads(pickle.dumps(read_video(tmp_path / name)[7:11]))
    assert part.names == ["07", "08", "09", "10"]
    assert part[::-1][1].equal(in_order[9])
    with pytest.raises(IndexError):
        frames[12]


FORK = """
import os, signal, sys
import torch
from spikekit.io.video import read_video

torch.set_num_threads(1)  # OpenMP's threads do not survive a fork
frames = read_video(sys.argv[1])
in_order = list(frames)
frames[3]
child = os.fork()
if not child:
    signal.alarm(60)
    os._exit(0 if all(frames[n].equal(in_order[n]) for n in (9, 4)) else 1)
assert os.waitpid(child, 0)[1] == 0, "the child"
assert frames[4].equal(in_order[4]), "the parent"
"""


def test_fork_does_not_disturb_its_parent(tmp_path):
    film = write_film(tmp_path / "a.mkv", codec="ffv1")
    done = subprocess.run([sys.executable, "-c", FORK, film], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_threads_share_a_film(tmp_path):
    """Each thread gets its own frames."""
    film = read_video(write_film(tmp_path / "a.mp4", frames=6))
    expected = [film[n] for n in range(6)]

    def look(seed):
        order = np.random.default_rng(seed).integers(0, 6, 15)
        return all(film[n].equal(expected[n]) for n in order)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(8) as threads:
            assert all(threads.map(look, range(8)))
    finally:
        sys.setswitchinterval(before)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_rotated_film_is_upright(tmp_path, turns):
    """By the quarter turns in the display matrix of its header."""
    seen = torch.linspace(0.2, 0.8, SIZE[0] * SIZE[1]).reshape(1, *SIZE).expand(3, -1, -1)
    write_video(tmp_path / "a.mp4", [seen] * 3)
    data = (tmp_path / "a.mp4").read_bytes()
    upright = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns]
    matrix = struct.pack(">9i", cos << 16, sin << 16, 0, -sin << 16, cos << 16, 0, 0, 0, 1 << 30)
    place = data.index(upright, data.index(b"tkhd"))
    (tmp_path / "a.mp4").write_bytes(data[:place] + matrix + data[place + len(matrix) :])
    film = read_video(tmp_path / "a.mp4")
    expected = torch.rot90(seen, -turns, (1, 2))
    assert (film.height, film.width) == tuple(expected.shape[1:])
    assert (pickle.loads(pickle.dumps(film))[2] - expected).abs().max() < 0.02


def test_ten_bits_keep_their_depth(tmp_path):
    frames = read_video(write_film(tmp_path / "a.mkv", codec="ffv1", pixels="yuv420p10le", frames=12))
    assert any(abs(value * 255 - round(value * 255)) > 0.05 for rgb in frames for value in rgb.unique().tolist())
    assert level_of(frames[11]) == pytest.approx(11, abs=0.1)


def test_a_truncated_film_is_reported(tmp_path):
    """Earlier frames stay readable; missing ones raise every time."""
    write_film(tmp_path / "a.avi", codec="ffv1")
    write_film(tmp_path / "a.mp4", bf="0")
    for name, rest in (("a.avi", 0.8), ("a.mp4", 0.98)):
        path, frames = tmp_path / name, list(read_video(tmp_path / name))
        path.write_bytes(path.read_bytes()[: int(path.stat().st_size * rest)])
        cut, reached = read_video(path), []
        with pytest.raises(VideoError, match=rf"{re.escape(str(path))}.*frame"):
            reached.extend(cut)
        assert 0 < len(reached) < 12
        assert all(rgb.equal(whole) for rgb, whole in zip(reached, frames, strict=False))
        for _ in range(2):
            with pytest.raises(VideoError):
                cut[len(reached)]
            assert cut[0].equal(frames[0])


# --- written ----------------------------------------------------------------------------------------------------------


def dusk(count, height=33, width=47):
    """A picture of four colours that grows darker."""
    rgb = torch.tensor([[0.9, 0.1, 0.1, 0.5], [0.1, 0.9, 0.1, 0.5], [0.1, 0.1, 0.9, 0.5]])
    rows, columns = (torch.arange(side) * 2 // side for side in (height, width))
    rgb = rgb[:, 2 * rows[:, None] + columns]
    return [rgb * (1 - n / (2 * count)) for n in range(count)]


def decoded(path):
    if path.suffix != ".gif":
        return torch.stack(list(read_video(path))), read_video(path).fps
    with pytest.importorskip("av").open(str(path)) as film:
        pictures = [torch.from_numpy(frame.to_ndarray(format="rgb24")) for frame in film.decode(video=0)]
        return torch.stack(pictures).movedim(-1, 1) / 255, float(film.streams.video[0].average_rate)


@pytest.mark.parametrize(
    ("ending", "size"), [("mp4", (34, 48)), ("mov", (34, 48)), ("mkv", (34, 48)), ("gif", (33, 47))]
)
def test_written_film_has_the_colours_of_its_frames(tmp_path, ending, size):
    frames = dusk(12)
    write_video(tmp_path / "new" / f"dusk.{ending}", frames, fps=10)
    found, fps = decoded(tmp_path / "new" / f"dusk.{ending}")
    assert found.shape == (12, 3, *size)
    assert fps == 10
    for y, x in ((8, 12), (8, 36), (25, 12), (25, 36)):  # away from edges, where colours of neighbours mix
        torch.testing.assert_close(found[:, :, y, x], torch.stack(frames)[:, :, y, x], rtol=0, atol=0.02)
    assert [path.name for path in (tmp_path / "new").iterdir()] == [f"dusk.{ending}"]


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_frames_are_consumed_one_by_one(tmp_path, ending):
    alive, most = weakref.WeakSet(), 0

    def frames():
        nonlocal most
        for n in range(20):
            frame = torch.full((3, 16, 16), n / 20)
            alive.add(frame)
            most = max(most, len(alive))
            yield frame

    write_video(tmp_path / f"long.{ending}", frames())
    assert most <= 3


def test_failed_film_gives_one_line_and_no_file(tmp_path, monkeypatch):
    good = dusk(2)
    (tmp_path / "file").touch()
    for path, frames, fps, error, said in (
        ("a.avi", good, 25, VideoError, "a.avi: expected a film that ends in .mp4, .mov, .mkv, .gif"),
        ("a.mp4", [], 25, VideoError, "a.mp4: expected at least one frame, got none"),
        ("a.mp4", [*good, good[0][:, 1:]], 25, VideoError, "expected 33 x 47 .* as the first frame, got 32 x 47"),
        ("file/a.mp4", good, 25, OSError, r"file.a\.mp4"),
        ("a.mp4", [torch.zeros(3, 4, 4, dtype=torch.int16)], 25, TypeError, "expected a floating-point tensor"),
    ):
        with pytest.raises(error, match=said) as refused:
            write_video(tmp_path / path, frames, fps)
        assert "\n" not in str(refused.value)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(VideoError, match=r"a.mp4: writing a film needs PyAV, pip install '.\[video\]'"):
        write_video(tmp_path / "a.mp4", good)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("fps", [np.float32(25), np.int64(25), Fraction(25), torch.tensor(25.0)])
def test_fps_of_any_numeric_type_and_uint8_frames(tmp_path, fps):
    write_video(tmp_path / "a.mp4", frames := dusk(2), fps=fps)
    assert read_video(tmp_path / "a.mp4").fps == 25
    write_video(tmp_path / "b.mp4", [(255 * frame).round().to(torch.uint8) for frame in frames])
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
