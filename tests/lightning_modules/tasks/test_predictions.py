"""Pictures and films of ``lightning predict``, as its users type it: killed, continued, with bad disks, in parts."""

import errno
import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from PIL import Image

from lightning_modules.__main__ import main
from lightning_modules.tasks import predictions
from spikekit import read_picture, read_video, write_spikes
from spikekit.io import video_output

pytest.importorskip("av")


@pytest.fixture(name="words")
def _words(tmp_path):
    """What makes a picture of every tenth frame, six in all, without weights."""
    write_spikes(tmp_path / "clip.npz", torch.rand(99, 12, 16, generator=torch.Generator().manual_seed(0)) < 0.3)
    data = ["--data", "Recording", "--data.path", str(tmp_path / "clip.npz"), "--data.every", "10"]
    network = ["--model.network", "ClassicalDecoder", "--model.network.scale", "2"]
    return ["predict", *network, *data, "--trainer.accelerator", "cpu", "-o"]


def pictures(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.png")}


def stop_after(monkeypatch, count):
    """Have the run end in the middle of writing a picture, with what a killed one leaves behind."""
    made, write = [], predictions.png_bytes

    def png_bytes(*args):
        if len(made) == count:
            raise KeyboardInterrupt
        made.append(None)
        return write(*args)

    monkeypatch.setattr(predictions, "png_bytes", png_bytes)


def test_a_film_shows_the_pictures_of_the_folder(words, tmp_path, capsys):
    main([*words, str(tmp_path / "out")])
    main([*words, str(tmp_path / "a" / "film.mkv"), "--fps", "12"])
    film = read_video(tmp_path / "a" / "film.mkv")
    assert len(film) == 6
    assert film.fps == 12
    for name, frame in zip(sorted(pictures(tmp_path / "out")), film, strict=True):
        assert (read_picture(tmp_path / "out" / name) - frame).abs().mean() < 0.06  # colours are stored two by two
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["film.mkv"]
    said = capsys.readouterr().out
    assert "film.mkv: 6 pictures, 0." in said
    assert " s a frame: reading 0." in said


def test_a_decoder_stands_beside_the_picture(words, tmp_path):
    one, other = tmp_path / "tfi", tmp_path / "both"
    main([*words, str(one), "--data.frame", "40", "--model.network.method", "tfi"])
    main([*words, str(other), "--data.frame", "40", "--beside", "tfi"])
    both = read_picture(other / "frame_000040.png")
    assert both.shape == (3, 24, 32 + 4 + 32)
    torch.testing.assert_close(both[:, :, :32], read_picture(one / "frame_000040.png"), rtol=0, atol=1.1 / 255)
    assert not torch.allclose(both[:, :, :32], both[:, :, 36:], rtol=0, atol=0.1)


def test_pictures_of_a_grey_camera_are_grey(words, tmp_path):
    main([*words, str(tmp_path / "out"), "--data.frame", "40", "--data.pattern", "grey"])
    red, green, blue = read_picture(tmp_path / "out" / "frame_000040.png")
    assert red.equal(green)
    assert red.equal(blue)
    assert red.std() > 0


@pytest.mark.parametrize("name", ["out", "film.mp4"])
def test_what_is_there_is_not_made_again(words, tmp_path, monkeypatch, name):
    main([*words, str(tmp_path / "unbroken")])
    monkeypatch.setattr(predictions.shutil, "rmtree", lambda *_, **__: None)
    folder = predictions.pictures_folder(tmp_path / name)
    with monkeypatch.context() as patch:
        stop_after(patch, 2)
        with pytest.raises(SystemExit):
            main([*words, str(tmp_path / name)])
    assert len(pictures(folder)) == 2
    assert not (tmp_path / "film.mp4").exists()
    stop_after(monkeypatch, 4)  # the others, and no more
    main([*words, str(tmp_path / name)])
    assert pictures(folder) == pictures(tmp_path / "unbroken")
    main([*words, str(tmp_path / name)])  # nothing is left to do


def test_what_was_made_otherwise_is_made_again(words, tmp_path):
    main([*words, str(tmp_path / "out")])
    before = pictures(tmp_path / "out")
    Image.new("RGB", (32, 24)).save(tmp_path / "out" / "frame_000040.png")
    main([*words, str(tmp_path / "out")])
    assert pictures(tmp_path / "out") == before
    for change in (["--model.network.method", "tfi"], ["--data.white", "0.4"]):
        main([*words, str(tmp_path / "out"), "--data.frame", "40", *change])
        after = pictures(tmp_path / "out")
        assert {name for name in before if before[name] != after[name]} == {"frame_000040.png"}
        before = after
    path = tmp_path / "clip.npz"
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1_000_000_000))
    main([*words, str(tmp_path / "out")])
    assert all(before[name] != data for name, data in pictures(tmp_path / "out").items())


def test_a_full_disk_is_one_line_and_no_film(words, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    for module, function, said in (
        (predictions, "png_bytes", "frame_000020.png"),
        (video_output, "_h264", "film.mp4"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, function, full)
            with pytest.raises(
                SystemExit, match=rf"^lightning: .*{said}: cannot be written \(No space left on device\)$"
            ):
                main([*words, str(tmp_path / "film.mp4")])
        assert not (tmp_path / "film.mp4").exists()
    main([*words, str(tmp_path / "film.mp4")])
    assert len(read_video(tmp_path / "film.mp4")) == 6


def command(words, *more, **how):
    line = [sys.executable, "-m", "lightning_modules", *map(str, [*words, *more])]
    return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **how)


@pytest.mark.slow
def test_a_killed_film_goes_on(words, tmp_path):
    words = [*words, tmp_path / "film.mp4", "--data.every", 1]
    with command(words) as process:
        begin = time.monotonic()
        while not any((tmp_path / "film.mp4.frames").glob("*.png")) and time.monotonic() < begin + 120:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    left = pictures(tmp_path / "film.mp4.frames")
    assert 0 < len(left) < 59
    assert not (tmp_path / "film.mp4").exists()
    for path in (tmp_path / "film.mp4.frames").glob("*.png"):
        assert read_picture(path).shape == (3, 24, 32)
    with command(words) as process:
        assert process.wait() == 0, process.stderr.read()
    assert len(read_video(tmp_path / "film.mp4")) == 59
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip.npz", "film.mp4"]


@pytest.mark.slow
def test_two_processes_make_what_one_makes(words, tmp_path):
    with command(words, tmp_path / "one") as process:
        assert process.wait() == 0, process.stderr.read()
    with command(words, tmp_path / "two", "--trainer.devices", 2) as process:
        assert process.wait() == 0, process.stderr.read()
    assert pictures(tmp_path / "one") == pictures(tmp_path / "two")
    with command(words, tmp_path / "film.mp4", "--trainer.devices", 2) as process:
        assert process.wait() == 0, process.stderr.read()
    assert len(read_video(tmp_path / "film.mp4")) == 6


_PEAK = """
import resource, sys
from lightning_modules.__main__ import main
main(sys.argv[1:])
print("peak", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux alone")
def test_memory_does_not_grow_with_the_recording(words, tmp_path):
    peaks = []
    for frames in (200, 2000):  # of 12.5 kB packed and 100 kB unpacked
        path = tmp_path / f"{frames}.dat"
        path.write_bytes(bytes(range(250)) * 50 * frames)
        data = ["--data.path", path, "--data.height", 250, "--data.width", 400, "--data.every", 40]
        run = [sys.executable, "-c", _PEAK, *words, tmp_path / f"{frames}.mp4", *data]
        done = subprocess.run([*map(str, run)], capture_output=True, text=True, check=True)
        peaks.append(int(done.stdout.split("peak ")[1]) / 1024)
    assert peaks[1] < peaks[0] + 60  # MiB; the 2000 frames are 190 MiB
