"""Frames in: folders and video files, lazily, in order, and what is wrong with them in one line."""

import pickle
import re
import struct
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from PIL import Image

from spikekit import write_picture, write_video
from spikekit.io import video as video_module
from spikekit.io.video import VideoError, VideoFrames, read_video

SIZE = (48, 64)


def frame(n, height=6, width=8):
    """A picture that says which one it is."""
    return torch.full((3, height, width), n / 255)


def folder_of(path, names, **size):
    for n, name in enumerate(names):
        write_picture(path / name, frame(n, **size))
    return path


def number(rgb):
    return round(rgb.mean().item() * 255)


@pytest.fixture
def opened(monkeypatch):
    """The pictures that were read, in order."""
    names = []
    read = video_module.read_picture
    monkeypatch.setattr(video_module, "read_picture", lambda path: names.append(path.name) or read(path))
    return names


def fails(path, *words, **choice):
    """One line that names the file and holds the words."""
    with pytest.raises(VideoError) as info:
        list(read_video(path, **choice))
    said = str(info.value)
    assert isinstance(info.value, ValueError)
    assert "\n" not in said
    for word in (str(path), *map(str, words)):
        assert word in said, said
    return said


# --- folders ----------------------------------------------------------------------------------------------------------


def test_a_folder_is_a_lazy_sequence(tmp_path, opened):
    frames = read_video(folder_of(tmp_path, [f"f{n}.png" for n in range(12)]))
    assert isinstance(frames, Sequence)
    assert isinstance(frames, VideoFrames)
    assert (len(frames), frames.height, frames.width, frames.fps) == (12, 6, 8, None)
    assert frames.names == [f"f{n}.png" for n in range(12)]
    part = frames[2:9:3]
    assert len(part) == 3
    assert not opened
    assert frames[10].dtype == torch.float32
    assert frames[10].shape == (3, 6, 8)
    assert opened == ["f10.png"] * 2
    assert [number(rgb) for rgb in part] == [2, 5, 8]
    assert opened[2:] == ["f2.png", "f5.png", "f8.png"]
    assert part.names == ["f2.png", "f5.png", "f8.png"]
    assert [number(rgb) for rgb in frames[::-1][:2]] == [11, 10]
    assert number(frames[-1]) == 11
    with pytest.raises(IndexError):
        frames[12]
    with pytest.raises(IndexError):
        part[3]


def test_start_and_count(tmp_path):
    folder_of(tmp_path, [f"{n}.png" for n in range(5)])
    assert [number(rgb) for rgb in read_video(tmp_path, start=1, count=3)] == [1, 2, 3]
    assert [number(rgb) for rgb in read_video(tmp_path, start=3)] == [3, 4]
    fails(tmp_path, "frame 5", "got 5 frames", start=5)
    fails(tmp_path, "3 frames from frame 3 on", "got 5 frames", start=3, count=3)
    fails(tmp_path, "frame -1", start=-1)
    with pytest.raises(ValueError, match="count"):
        read_video(tmp_path, count=0)
    with pytest.raises(TypeError):
        read_video(tmp_path, start=1.5)


def test_natural_order_and_what_is_no_picture(tmp_path):
    names = ["a1b2.png", "a1b10.bmp", "a2.JPG", "a010.tif", "a11.jpeg", "b.png"]
    folder_of(tmp_path, names)
    folder_of(tmp_path, [".hidden.png", "deeper/a0.png"])
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "Thumbs.db").write_bytes(b"0")
    frames = read_video(tmp_path)
    assert frames.names == names
    assert [number(rgb) for rgb in frames] == list(range(6))


def test_a_still_film(tmp_path):
    folder_of(tmp_path, ["only.png"])
    for path in (tmp_path, tmp_path / "only.png", str(tmp_path)):
        frames = read_video(path)
        assert (len(frames), frames.names, number(frames[0])) == (1, ["only.png"], 0)


def test_all_kinds_of_pictures_in_one_film(tmp_path):
    Image.new("L", (8, 6), 51).save(tmp_path / "1.png")
    Image.fromarray(np.full((6, 8), 13107, np.uint16)).save(tmp_path / "2.png")
    Image.new("RGBA", (8, 6), (51, 51, 51, 255)).save(tmp_path / "3.png")
    Image.new("RGB", (8, 6), (51, 51, 51)).convert("P").save(tmp_path / "4.png")
    Image.new("RGBA", (8, 6), (0, 0, 0, 204)).save(tmp_path / "5.png")  # 4/5 black over white
    Image.fromarray(np.full((6, 8), 0.2, np.float32)).save(tmp_path / "6.tif")
    for rgb in read_video(tmp_path):
        assert rgb.shape == (3, 6, 8)
        assert torch.allclose(rgb, torch.tensor(0.2), atol=1e-6)


def test_mixed_sizes_name_both(tmp_path, opened):
    folder_of(tmp_path, ["0.png", "1.png"])
    write_picture(tmp_path / "2.png", frame(2, 6, 9))
    said = fails(tmp_path, tmp_path / "2.png", "6 x 9", "6 x 8", tmp_path / "0.png")
    assert said.startswith(str(tmp_path / "2.png"))
    assert not opened  # the headers were enough


def test_a_damaged_picture_in_the_middle(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (40, 50, 3)).astype(np.uint8)
    for n in range(4):
        Image.fromarray(noise).save(tmp_path / f"{n}.png")
    whole = (tmp_path / "2.png").read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:20], b"", b"no picture"):
        (tmp_path / "2.png").write_bytes(damaged)
        frames = read_video(tmp_path)
        assert frames[0].equal(frames[1])
        with pytest.raises(VideoError, match=re.escape(str(tmp_path / "2.png"))) as info:
            frames[2]
        assert "\n" not in str(info.value)
        assert str(info.value).count("2.png:") == 1
        assert frames[3].equal(frames[0])
    Image.fromarray(noise).save(tmp_path / "2.jpg")
    (tmp_path / "2.png").unlink()
    (tmp_path / "2.jpg").write_bytes((tmp_path / "2.jpg").read_bytes()[:-900])
    with pytest.raises(VideoError, match=r"2\.jpg"):
        list(read_video(tmp_path))


def test_a_missing_target_is_not_left_out(tmp_path):
    folder_of(tmp_path, ["0.png", "2.png"])
    (tmp_path / "1.png").symlink_to(tmp_path / "gone.png")
    fails(tmp_path, tmp_path / "1.png")


@pytest.mark.parametrize("value", [-0.1, 1.5, float("nan")])
def test_values_beyond_white(tmp_path, value):
    Image.fromarray(np.full((6, 8), value, np.float32)).save(tmp_path / "0.tif")
    fails(tmp_path, tmp_path / "0.tif", "[0, 1]")


def test_what_is_no_film(tmp_path):
    fails(tmp_path / "nothing", "no such file")
    fails(tmp_path, "expected pictures", "none")
    folder_of(tmp_path, ["walk/0.png", "city/0.png"])
    fails(tmp_path, "folders (city, walk)")
    (tmp_path / "notes.txt").write_text("no film")
    fails(tmp_path / "notes.txt", "expected a folder of pictures")
    fails(tmp_path / "notes.txt" / "deeper")
    (tmp_path / "bad.png").write_text("no film")
    fails(tmp_path / "bad.png", "not a picture")


# --- video files ------------------------------------------------------------------------------------------------------


def write_film(path, frames=30, codec="libx264", pixels="yuv420p", level=8, **options):
    """A film whose frame n is grey of ``level * n``."""
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
    return rgb.mean().item() * 255 / 8


KINDS = [
    ("a.mp4", "libx264", {"bf": "3", "g": "10"}),
    ("a.mkv", "ffv1", {}),
    ("a.avi", "mpeg4", {}),
    ("a.mov", "libx264", {}),
    ("a.webm", "libvpx", {"auto-alt-ref": "1", "lag-in-frames": "16"}),
    ("a.y4m", "wrapped_avframe", {}),
]


@pytest.mark.parametrize(("name", "codec", "options"), KINDS)
def test_a_video_file(tmp_path, name, codec, options):
    frames = read_video(write_film(tmp_path / name, codec=codec, **options))
    assert (len(frames), frames.height, frames.width, frames.fps) == (30, *SIZE, 25)
    assert (frames.names[0], frames.names[29]) == ("00", "29")
    for n, rgb in enumerate(frames):
        assert rgb.shape == (3, *SIZE)
        assert rgb.dtype == torch.float32
        assert level_of(rgb) == pytest.approx(n, abs=0.4)
    with pytest.raises(IndexError):
        frames[30]


def test_every_frame_is_the_same_one_in_any_order(tmp_path):
    path = write_film(tmp_path / "a.mp4", bf="3", g="10")
    inorder = list(read_video(path))
    frames = read_video(path)
    for n in (5, 4, 12, 12, 3, 29, 22, 0, 28):
        assert frames[n].equal(inorder[n]), n
    part = read_video(path, start=7, count=5)
    assert part.names == ["07", "08", "09", "10", "11"]
    assert part[::-1][1].equal(inorder[10])
    copied = pickle.loads(pickle.dumps(part))
    assert copied[2].equal(inorder[9])


FORK = """
import os, signal, sys
import torch
from spikekit.io.video import read_video

torch.set_num_threads(1)  # OpenMP's threads do not survive a fork
frames = read_video(sys.argv[1])
inorder = list(frames)
frames[3]
child = os.fork()
if not child:
    signal.alarm(60)
    os._exit(0 if all(frames[n].equal(inorder[n]) for n in (20, 4)) else 1)
assert os.waitpid(child, 0)[1] == 0, "the child"
assert frames[4].equal(inorder[4]), "the parent"
"""


def test_a_fork_leaves_its_parent_where_it_was(tmp_path):
    film = write_film(tmp_path / "a.mkv", codec="ffv1")
    done = subprocess.run([sys.executable, "-c", FORK, film], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_threads_share_a_film(tmp_path):
    """Each gets the frames that it asks for, whatever others ask for."""
    write_video(tmp_path / "a.mp4", [frame(40 * n, *SIZE) for n in range(6)])
    film = read_video(tmp_path / "a.mp4")
    expected = [film[n] for n in range(6)]

    def look(seed):
        order = np.random.default_rng(seed).integers(0, 6, 30)
        return all(film[n].equal(expected[n]) for n in order)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(8) as threads:
            assert all(threads.map(look, range(8)))
    finally:
        sys.setswitchinterval(before)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_film_of_a_phone_is_upright(tmp_path, turns):
    """As the matrix in its header says: by so many quarter turns clockwise."""
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
    frames = read_video(write_film(tmp_path / "a.mkv", codec="ffv1", pixels="yuv420p10le", frames=20))
    assert any(abs(value * 255 - round(value * 255)) > 0.05 for rgb in frames for value in rgb.unique().tolist())
    assert level_of(frames[19]) == pytest.approx(19, abs=0.1)


def test_damaged_video_files(tmp_path):
    whole = write_film(tmp_path / "a.avi", codec="ffv1").read_bytes()
    frames = list(read_video(tmp_path / "a.avi"))
    (tmp_path / "cut.avi").write_bytes(whole[: len(whole) * 8 // 10])
    cut = read_video(tmp_path / "cut.avi")
    reached = []
    with pytest.raises(VideoError, match=rf"{re.escape(str(tmp_path / 'cut.avi'))}.*frame"):
        reached.extend(cut)
    assert 3 < len(reached) < 29
    assert all(rgb.equal(whole) for rgb, whole in zip(reached, frames, strict=False))
    assert cut[3].equal(frames[3])  # what came before stays usable
    said = []
    for _ in range(2):
        with pytest.raises(VideoError) as info:
            cut[len(reached)]
        said.append(str(info.value))
    assert said[0] == said[1]
    for name, data in (("empty.mp4", b""), ("text.mp4", b"no film " * 99), ("short.avi", whole[:40])):
        (tmp_path / name).write_bytes(data)
        fails(tmp_path / name)


def test_a_film_shorter_than_its_header_says(tmp_path):
    whole = write_film(tmp_path / "a.mp4", bf="0").read_bytes()
    (tmp_path / "a.mp4").write_bytes(whole[:-200])
    frames = read_video(tmp_path / "a.mp4")
    assert len(frames) == 30  # what is missing is told, not left out
    fails(tmp_path / "a.mp4", "ends after", "of 30 frames")
    for _ in range(2):  # an error does not stand in the way of what can be read
        with pytest.raises(VideoError):
            frames[29]
        assert level_of(frames[0]) == pytest.approx(0, abs=0.4)


def test_of_several_streams_the_first_is_the_film(tmp_path):
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        streams = [container.add_stream("ffv1", rate=25) for _ in range(2)]
        for stream in streams:
            stream.height, stream.width, stream.pix_fmt = 32, 48, "yuv420p"
        for n, stream in enumerate(streams):
            for _ in range(2):
                grey = np.full((32, 48, 3), 60 + 120 * n, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="rgb24")))
            container.mux(stream.encode(None))
    assert [number(rgb) for rgb in read_video(tmp_path / "a.mkv")] == [60, 60]


def test_sound_is_no_film(tmp_path):
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    fails(tmp_path / "a.mkv", "expected a video")


def test_without_pyav(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "a.mp4").write_bytes(b"0")
    fails(tmp_path / "a.mp4", "pip install '.[video]'")
