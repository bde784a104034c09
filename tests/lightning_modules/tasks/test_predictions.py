"""Pictures and films of ``lightning predict``, as its users type it: killed, continued, with bad disks, in parts."""

import errno
import json
import os
import re
import shutil
import subprocess
import sys
import time

import pytest
import torch
from PIL import Image

from lightning_modules.__main__ import main
from lightning_modules.cli import processes
from lightning_modules.inference.film import film
from lightning_modules.networks import CSCSR, ClassicalDecoder, RecurrentCSCSR
from lightning_modules.storage.pretrained import Weights, settings_of, write_weights
from lightning_modules.tasks import predictions
from spikekit import read_picture, read_spikes, read_video, write_spikes
from spikekit.cli.command import main as spikekit
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


def test_a_picture_of_nan_is_no_picture(words, tmp_path, monkeypatch):
    """Weights may be finite and too large; a black picture would say nothing of it."""
    nan = torch.full((1, 3, 24, 32), float("nan"))
    monkeypatch.setattr(ClassicalDecoder, "forward", lambda *_: nan)
    with pytest.raises(SystemExit, match=r"^lightning: .*frame_000020.png: expected a picture, the network makes NaN"):
        main([*words, str(tmp_path / "out")])
    assert not pictures(tmp_path / "out")


def test_one_frame_is_one_picture(words, tmp_path, capsys):
    main([*words, str(tmp_path / "out"), "--data.frame", "40"])
    main([*words, str(tmp_path / "a" / "one.PNG"), "--data.frame", "40"])
    assert (tmp_path / "a" / "one.PNG").read_bytes() == (tmp_path / "out" / "frame_000040.png").read_bytes()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["one.PNG"]
    assert "one.PNG: 1 picture," in capsys.readouterr().out


def test_the_frames_of_a_clip_choose_no_pictures(words, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([*words, str(tmp_path / "out"), "--data.frames", "20:60"])
    said = "data.frames: expected int, got '20:60', the frames of a clip; --data.frame chooses pictures"
    assert said in capsys.readouterr().err


def test_a_picture_for_several_frames_is_refused(words, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit:
        main([*words, str(tmp_path / "b" / "one.png"), "--data.frame", "20:60"])
    assert exit.value.code == 2
    assert "-o: expected a folder or a film for 4 pictures, got" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()


def test_the_truth_of_a_simulated_recording_is_not_written_over(words, tmp_path, capsys):
    Image.effect_noise((40, 32), 60).convert("RGB").save(tmp_path / "scene.png")
    spikekit(["simulate", str(tmp_path / "scene.png"), "-o", str(tmp_path / "a.dat"), "--scale", "2"])
    truth = (tmp_path / "a.png").read_bytes()
    words[words.index(str(tmp_path / "clip.npz"))] = str(tmp_path / "a.dat")
    with pytest.raises(SystemExit) as exit:
        main([*words, str(tmp_path / "a.png"), "--data.frame", "20"])
    assert exit.value.code == 2
    assert "a.png: the ground truth of a.json would be lost; choose another name" in capsys.readouterr().err
    assert (tmp_path / "a.png").read_bytes() == truth


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


def command(words, *more):
    return [sys.executable, "-m", "lightning_modules", *map(str, [*words, *more])]


def run(words, *more):
    done = subprocess.run(command(words, *more), capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(name="carries_on")
def _carries_on(words, tmp_path):
    """The same by a network whose pictures depend on their neighbours."""
    torch.manual_seed(0)
    network = RecurrentCSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
    for weight in (network.fusion.share.weight, network.fusion.rest.weight):
        torch.nn.init.normal_(weight, std=0.05)
    weights = Weights(tmp_path, settings_of(network), {}, network.state_dict())
    write_weights(weights, tmp_path / "film.safetensors")
    data = words[words.index("--data") : -1]
    return ["predict", "--model.weights", str(tmp_path / "film.safetensors"), *data, "-o"]


@pytest.mark.parametrize("future", [0, 3])
def test_a_network_carries_on_through_a_film_and_where_it_was_stopped(carries_on, tmp_path, monkeypatch, future):
    words = [*carries_on, str(tmp_path / "out"), "--model.future", str(future), "--data.white", "0.3"]
    main(words)
    unbroken = pictures(tmp_path / "out")
    network = RecurrentCSCSR.from_pretrained(tmp_path / "film.safetensors")
    shown = list(film(network, [read_spikes(tmp_path / "clip.npz")], 10, future=future, white=0.3))
    assert sorted(unbroken) == [f"frame_{frame.clock:06d}.png" for frame in shown]
    for name, frame in zip(sorted(unbroken), shown, strict=True):
        torch.testing.assert_close(read_picture(tmp_path / "out" / name), frame.rgb, rtol=0, atol=0.51 / 255)
    (tmp_path / "out" / "frame_000040.png").unlink()
    (tmp_path / "out" / "frame_000070.png").unlink()
    stop_after(monkeypatch, 2)
    timed = []
    monkeypatch.setattr(predictions.Stopwatch, "said", lambda _, frames: timed.append(frames))
    main(words)
    assert pictures(tmp_path / "out") == unbroken
    assert timed == [6]  # two that were missing, four that help them
    monkeypatch.undo()
    main([*carries_on, str(tmp_path / "alone"), "--data.frame", "40", "--data.white", "0.3"])
    assert pictures(tmp_path / "alone")["frame_000040.png"] != unbroken["frame_000040.png"]


def test_a_film_of_interpolated_pictures_goes_on_where_it_was_stopped_and_has_parts(words, tmp_path, monkeypatch):
    network = CSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1, skip=True)
    write_weights(Weights(tmp_path, settings_of(network), {}, network.state_dict()), tmp_path / "alone.safetensors")
    data = words[words.index("--data") : -1]
    words = ["predict", "--model.weights", str(tmp_path / "alone.safetensors"), *data, "--data.white", "0.3", "-o"]
    main([*words, str(tmp_path / "all")])
    words = [*words, str(tmp_path / "out"), "--model.interpolated", "1"]
    main(words)
    every, unbroken = pictures(tmp_path / "all"), pictures(tmp_path / "out")
    light = {name: read_picture(tmp_path / "all" / name) for name in every}
    for n, name in enumerate(sorted(unbroken)):  # 20, 30 .. 70: every other one is of the network, and the last
        same = read_picture(tmp_path / "out" / name).equal(light[name])
        assert same == (n in (0, 2, 4, 5))
    stop = ("frame_000030.png", "frame_000050.png", "frame_000060.png", "frame_000070.png")
    for name in stop:
        (tmp_path / "out" / name).unlink()
    stop_after(monkeypatch, 2)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        main(words)
    assert len(pictures(tmp_path / "out")) == 4
    monkeypatch.undo()
    main(words)
    assert pictures(tmp_path / "out") == unbroken
    words[words.index(str(tmp_path / "out"))] = str(tmp_path / "parts")
    for part in ("2/2", "1/2"):
        main([*words, "--part", part])
    assert pictures(tmp_path / "parts") == unbroken


@pytest.mark.slow
def test_a_network_that_carries_on_is_the_same_in_two_processes(carries_on, tmp_path, in_two_processes):
    main([*carries_on, str(tmp_path / "one"), "--model.future", "1"])
    in_two_processes([*carries_on, tmp_path / "two", "--model.future", 1])
    assert pictures(tmp_path / "one") == pictures(tmp_path / "two")


@pytest.mark.slow
def test_a_killed_film_goes_on(words, tmp_path, forked):
    words = [*words, str(tmp_path / "film.mp4"), "--data.every", "1"]
    process, begin = forked(words), time.monotonic()
    while not any((tmp_path / "film.mp4.frames").glob("*.png")) and time.monotonic() < begin + 120:
        time.sleep(0.01)
    process.kill()
    process.join()
    left = pictures(tmp_path / "film.mp4.frames")
    assert 0 < len(left) < 59
    assert not (tmp_path / "film.mp4").exists()
    for path in (tmp_path / "film.mp4.frames").glob("*.png"):
        assert read_picture(path).shape == (3, 24, 32)
    main(words)
    assert len(read_video(tmp_path / "film.mp4")) == 59
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip.npz", "film.mp4"]


@pytest.mark.slow
def test_two_processes_make_what_one_makes(words, tmp_path, in_two_processes):
    main([*words, str(tmp_path / "one")])
    main([*words, str(tmp_path / "one.mp4")])
    run(words, tmp_path / "two", "--trainer.devices", 2)
    assert pictures(tmp_path / "one") == pictures(tmp_path / "two")
    shutil.move(tmp_path / "two", tmp_path / "two.mp4.frames")
    (tmp_path / "two.mp4.frames" / "frame_000040.png").unlink()  # fewer pictures than processes
    in_two_processes([*words, tmp_path / "two.mp4"])
    assert len(read_video(tmp_path / "two.mp4")) == 6
    assert (tmp_path / "two.mp4").read_bytes() == (tmp_path / "one.mp4").read_bytes()


def test_parts_make_what_one_makes(words, tmp_path):
    main([*words, str(tmp_path / "one")])
    for part in ("3/4", "1/4", "4/4", "2/4"):
        before = len(pictures(tmp_path / "film.mp4.frames"))
        main([*words, str(tmp_path / "film.mp4"), "--part", part])
        assert len(pictures(tmp_path / "film.mp4.frames")) == before + (2 if part in ("2/4", "4/4") else 1)
    assert pictures(tmp_path / "one") == pictures(tmp_path / "film.mp4.frames")
    main([*words, str(tmp_path / "film.mp4")])
    assert len(read_video(tmp_path / "film.mp4")) == 6
    with pytest.raises(SystemExit, match="--part: expected at most 4 of 4, got 5"):
        main([*words, str(tmp_path / "film.mp4"), "--part", "5/4"])


@pytest.mark.slow
def test_ray_makes_what_one_process_makes(words, tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="Ray is an extra")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    words = [*words[:-1], "--data.every", "20", "-o"]
    main([*words, str(tmp_path / "one.mp4")])
    main([*words, str(tmp_path / "many.mp4"), "--engine", "ray", "--jobs", "2"])
    assert len(read_video(tmp_path / "many.mp4")) == 3
    assert (tmp_path / "many.mp4").read_bytes() == (tmp_path / "one.mp4").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip.npz", "many.mp4", "one.mp4"]


def test_ray_is_said_to_be_missing(words, tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "find_spec", lambda _: None)
    with pytest.raises(SystemExit, match="predict: --engine ray: Ray is not installed"):
        main([*words, str(tmp_path / "out"), "--engine", "ray"])


_PEAK = """
import json, resource, sys
from lightning_modules.__main__ import main
for words in json.loads(sys.argv[1]):
    main(words)
    print("peak", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux alone")
def test_memory_does_not_grow_with_the_recording(words, tmp_path):
    runs = []
    for frames in (200, 2000):  # of 12.5 kB packed and 100 kB unpacked
        path = tmp_path / f"{frames}.dat"
        path.write_bytes(bytes(range(250)) * 50 * frames)
        data = ["--data.path", path, "--data.height", 250, "--data.width", 400, "--data.every", 80]
        runs.append([*map(str, [*words, tmp_path / f"{frames}.mp4", *data])])
    run = [sys.executable, "-c", _PEAK, json.dumps(runs)]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    peaks = [int(peak) / 1024 for peak in re.findall(r"^peak (\d+)$", done.stdout, flags=re.MULTILINE)]
    assert peaks[1] < peaks[0] + 60  # MiB; the 2000 frames are 190 MiB


def test_progress_of_pictures_and_of_tiles_on_a_terminal(words, tmp_path, monkeypatch, capsys):
    words = [*words, str(tmp_path), "--model.tile", "8", "--model.self_ensemble", "2", "--data.frame", "20:41:20"]
    main(words)
    assert capsys.readouterr().err == ""  # that of the tests is no terminal
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setattr("spikekit.progress.AFTER", 0)
    for path in tmp_path.glob("*.png"):
        path.unlink()
    main(words)
    shown = capsys.readouterr().err
    assert re.search(r"pictures: .* 0/2 .*picture", shown)
    assert shown.count("this picture:   0%") >= 2
    assert " left" in shown
