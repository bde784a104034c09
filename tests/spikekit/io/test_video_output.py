"""Frames out: films that have the frames, in order, in their colours, or are not there at all."""

import sys
import weakref
from fractions import Fraction

import numpy as np
import pytest
import torch

from spikekit import read_video, write_video
from spikekit.io.video import VideoError

av = pytest.importorskip("av")


def dusk(count, height=33, width=47):
    """A picture of four colours that grows darker."""
    rgb = torch.tensor([[0.9, 0.1, 0.1, 0.5], [0.1, 0.9, 0.1, 0.5], [0.1, 0.1, 0.9, 0.5]])
    rows, columns = (torch.arange(side) * 2 // side for side in (height, width))
    rgb = rgb[:, 2 * rows[:, None] + columns]
    return [rgb * (1 - n / (2 * count)) for n in range(count)]


def decoded(path):
    if path.suffix != ".gif":
        return torch.stack(list(read_video(path))), read_video(path).fps
    with av.open(str(path)) as film:
        pictures = [torch.from_numpy(frame.to_ndarray(format="rgb24")) for frame in film.decode(video=0)]
        return torch.stack(pictures).movedim(-1, 1) / 255, float(film.streams.video[0].average_rate)


@pytest.mark.parametrize(
    ("ending", "size"), [("mp4", (34, 48)), ("mov", (34, 48)), ("mkv", (34, 48)), ("gif", (33, 47))]
)
def test_a_film_has_the_frames_in_their_colours(tmp_path, ending, size):
    frames = dusk(12)
    write_video(tmp_path / "new" / f"dusk.{ending}", frames, fps=10)
    found, fps = decoded(tmp_path / "new" / f"dusk.{ending}")
    assert found.shape == (12, 3, *size)
    assert fps == 10
    for y, x in ((8, 12), (8, 36), (25, 12), (25, 36)):  # away from edges, where colours of neighbours mix
        torch.testing.assert_close(found[:, :, y, x], torch.stack(frames)[:, :, y, x], rtol=0, atol=0.02)
    assert [path.name for path in (tmp_path / "new").iterdir()] == [f"dusk.{ending}"]


def test_bytes_are_written_as_they_are(tmp_path):
    frames = dusk(3)
    write_video(tmp_path / "a.mp4", frames)
    write_video(tmp_path / "b.mp4", [(255 * frame).round().to(torch.uint8) for frame in frames])
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_frames_are_asked_for_one_by_one_and_let_go(tmp_path, ending):
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


def test_what_cannot_be_a_film_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    good = dusk(2)
    for path, frames, said in (
        ("a.avi", good, "a.avi: expected a film that ends in .mp4, .mov, .mkv, .gif"),
        ("a.mp4", [], "a.mp4: expected at least one frame, got none"),
        ("a.mp4", [*good, good[0][:, 1:]], "expected frames of 33 x 47 .* got 32 x 47"),
    ):
        with pytest.raises(VideoError, match=said):
            write_video(tmp_path / path, frames)
    (tmp_path / "file").touch()
    with pytest.raises(VideoError, match="cannot be written") as refused:
        write_video(tmp_path / "file" / "a.mp4", good)
    assert "\n" not in str(refused.value)
    with pytest.raises(TypeError, match="frames: expected a floating-point tensor"):
        write_video(tmp_path / "a.mp4", [torch.zeros(3, 4, 4, dtype=torch.int16)])
    with pytest.raises(ValueError, match="fps"):
        write_video(tmp_path / "a.mp4", good, fps=0)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(VideoError, match=r"a.mp4: writing a film needs PyAV, pip install '.\[video\]'"):
        write_video(tmp_path / "a.mp4", good)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("fps", [np.float32(25), np.int64(25), Fraction(25), torch.tensor(25.0)])
def test_frames_a_second_are_any_kind_of_number(tmp_path, fps):
    write_video(tmp_path / "a.mp4", [torch.zeros(3, 16, 16)] * 2, fps=fps)
    assert read_video(tmp_path / "a.mp4").fps == 25
