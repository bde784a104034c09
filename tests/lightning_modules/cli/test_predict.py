"""``lightning predict``: pictures and films, stopped and resumed runs, and folders with other files."""

import os
import signal
import sys
import time

import pytest
import torch
import yaml
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from lightning_modules.__main__ import main
from lightning_modules.inference import output
from lightning_modules.networks import CSCSR, ClassicalDecoder
from lightning_modules.storage.pretrained import Weights, settings_of, write_weights
from spikekit import read_picture, read_video, write_spikes
from spikekit.cli.command import main as spikekit

pytest.importorskip("av")

DECODER = "model: {network: {class_path: ClassicalDecoder, init_args: {scale: 2, method: tfi}}}"


@pytest.fixture(name="words")
def _words(tmp_path):
    """What makes a picture of every tenth frame, six in all, without weights."""
    write_spikes(tmp_path / "clip.npz", torch.rand(99, 12, 16, generator=torch.Generator().manual_seed(0)) < 0.3)
    (tmp_path / "decoder.yaml").write_text(DECODER)
    return ["predict", str(tmp_path / "clip.npz"), "-c", str(tmp_path / "decoder.yaml"), "--frame", "20:79:10", "-o"]


def pictures(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.png")}


def stop_after(monkeypatch, count):
    """Have the run end in the middle of writing a picture, as by Ctrl-C."""
    made, write = [], output.png_bytes

    def png_bytes(*args):
        if len(made) == count:
            raise KeyboardInterrupt
        made.append(None)
        return write(*args)

    monkeypatch.setattr(output, "png_bytes", png_bytes)


def refused(words, status=1):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == status or (status == 1 and isinstance(ended.value.code, str))
    return str(ended.value.code)


def test_film_shows_the_pictures_of_the_folder(words, tmp_path, capsys):
    main([*words, str(tmp_path / "out")])
    main([*words, str(tmp_path / "a" / "film.mkv"), "--fps", "12"])
    film = read_video(tmp_path / "a" / "film.mkv")
    assert len(film) == 6
    assert film.fps == 12
    for name, frame in zip(sorted(pictures(tmp_path / "out")), film, strict=True):
        assert (read_picture(tmp_path / "out" / name) - frame).abs().mean() < 0.09  # colours are stored two by two
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["film.mkv"]
    assert "film.mkv: 6 pictures, in " in capsys.readouterr().out


def test_one_frame_gives_one_picture(words, tmp_path):
    main([*words, str(tmp_path / "out"), "--frame", "40"])
    main([*words, str(tmp_path / "a" / "one.PNG"), "--frame", "40"])
    assert (tmp_path / "a" / "one.PNG").read_bytes() == (tmp_path / "out" / "frame_000040.png").read_bytes()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["one.PNG"]


def test_nan_is_not_written(words, tmp_path, monkeypatch):
    """Finite weights that are too large give NaN, which would be saved as black."""
    nan = torch.full((1, 3, 24, 32), float("nan"))
    monkeypatch.setattr(ClassicalDecoder, "forward", lambda *_, static=False: nan)
    assert "frame_000020.png: expected finite values, got NaN" in refused([*words, str(tmp_path / "out")])
    assert not pictures(tmp_path / "out")


def test_ground_truth_of_a_recording_is_not_overwritten(words, tmp_path, capsys):
    Image.effect_noise((40, 32), 60).convert("RGB").save(tmp_path / "scene.png")
    spikekit(["simulate", str(tmp_path / "scene.png"), "-o", str(tmp_path / "a.dat"), "--scale", "2"])
    truth = (tmp_path / "a.png").read_bytes()
    words[1] = str(tmp_path / "a.dat")
    refused([*words, str(tmp_path / "a.png"), "--frame", "20"], 2)
    assert "a.png: would overwrite the ground truth of a.json" in capsys.readouterr().err
    assert (tmp_path / "a.png").read_bytes() == truth


def test_decoder_is_shown_beside_the_picture(words, tmp_path):
    one, other = tmp_path / "tfi", tmp_path / "both"
    main([*words, str(one), "--frame", "40"])
    main([*words, str(other), "--frame", "40", "--beside", "tfi"])
    both = read_picture(other / "frame_000040.png")
    assert both.shape == (3, 24, 32 + 4 + 32)
    torch.testing.assert_close(both[:, :, :32], read_picture(one / "frame_000040.png"), rtol=0, atol=1.1 / 255)


def test_stopped_run_resumes_after_its_last_picture(words, tmp_path, monkeypatch, capsys):
    main([*words, str(tmp_path / "unbroken")])
    for name, folder in (("out", tmp_path / "out"), ("film.mp4", tmp_path / "film.mp4.frames")):
        with monkeypatch.context() as patch:
            stop_after(patch, 2)
            refused([*words, str(tmp_path / name)], 130)
        assert len(capsys.readouterr().err.splitlines()) == 1
        before = pictures(folder)
        assert len(before) == 2
        (folder / ".predict.state.of_a_film").touch()
        with monkeypatch.context() as patch:
            stop_after(patch, 4)  # the others, and no more
            main([*words, str(tmp_path / name)])
        if name == "out":
            assert [path.name for path in folder.iterdir() if path.suffix != ".png"] == [".predict.lock"]
            assert before.items() <= pictures(folder).items()
            assert pictures(folder) == pictures(tmp_path / "unbroken")
    assert len(read_video(tmp_path / "film.mp4")) == 6
    assert not folder.exists()


def test_sigterm_ends_with_143_and_complete_pictures(words, tmp_path, forked):
    process, begin = forked([*words, str(tmp_path / "out"), "--frame", "20:79:1"]), time.monotonic()
    while not any((tmp_path / "out").glob("*.png")) and time.monotonic() < begin + 120:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGTERM)
    process.join()
    assert process.exitcode == 143
    left = pictures(tmp_path / "out")
    assert 0 < len(left) < 59
    for path in (tmp_path / "out").glob("*.png"):
        assert read_picture(path).shape == (3, 24, 32)
    assert not list((tmp_path / "out").glob("*.part"))


def test_outdated_and_damaged_pictures_are_made_again(words, tmp_path):
    folder = tmp_path / "out"
    main([*words, str(folder)])
    before = pictures(folder)
    path = folder / "frame_000040.png"
    data, note = bytearray(path.read_bytes()), PngInfo()
    data[-40] ^= 255  # a pixel, behind what says of what it was made
    with Image.open(path) as picture:
        note.add_text("spikekit", picture.info["spikekit"])
        lost = picture.point(lambda _: 0)
    for damage in (lambda: path.write_bytes(data), lambda: lost.save(path, pnginfo=note)):
        damage()
        main([*words, str(folder)])
        assert pictures(folder) == before
    main([*words, str(folder), "--white", "0.1"])
    assert all(before[name] != data for name, data in pictures(folder).items())


def test_other_files_beside_the_pictures_of_a_film_stay(words, tmp_path):
    folder = tmp_path / "film.mp4.frames"
    (folder / "mine").mkdir(parents=True)
    (folder / "mine" / "thesis.tex").write_text("all of it")
    (folder / "notes.txt").write_text("mine")
    main([*words, str(tmp_path / "film.mp4"), "--frame", "40"])
    assert (tmp_path / "film.mp4").is_file()
    assert sorted(path.name for path in folder.iterdir()) == ["mine", "notes.txt"]
    assert (folder / "mine" / "thesis.tex").read_text() == "all of it"


def test_links_foreign_files_and_pipes_are_not_written_to(words, tmp_path):
    (tmp_path / "other").mkdir()
    secret, out = tmp_path / "other" / "secret.txt", tmp_path / "out"
    secret.write_text("secret")
    out.mkdir()
    place = out / "frame_000040.png"
    for make in (
        lambda: place.symlink_to(secret),
        lambda: place.symlink_to(tmp_path / "other" / "new.png"),
        lambda: place.write_text("mine"),
        lambda: os.mkfifo(place),
        lambda: (out / ".predict.lock").symlink_to(secret),
    ):
        make()
        assert str(out) in refused([*words, str(out), "--frame", "40"])
        assert not list(out.glob("*.part"))
        (place if place.is_symlink() or place.exists() else out / ".predict.lock").unlink()
    (tmp_path / "film.mp4.frames").symlink_to(tmp_path / "other")
    assert "film.mp4.frames: expected a folder of pictures, got a link" in refused([*words, str(tmp_path / "film.mp4")])
    os.mkfifo(tmp_path / "pipe.mp4")
    assert "got a pipe or a device" in refused([*words, str(tmp_path / "pipe.mp4")])
    assert secret.read_text() == "secret"
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["secret.txt"]


def test_progress_on_a_terminal_and_elsewhere(words, tmp_path, monkeypatch, capsys):
    main([*words, str(tmp_path / "out")])
    said = capsys.readouterr()
    assert [line for line in said.out.splitlines() if "frame_0000" in line] == [
        f"{tmp_path}/out/frame_0000{frame}.png, {n} of 6" for n, frame in enumerate(range(20, 80, 10), 1)
    ]
    assert said.err == ""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    main([*words, str(tmp_path / "again")])
    said = capsys.readouterr()
    assert "frame_0000" not in said.out
    assert "pictures:" in said.err


TINY = {"scale": 2, "width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1}


def test_checkpoints_of_a_run_are_found_or_listed(words, tmp_path):
    network, last = CSCSR(**TINY), tmp_path / "run" / "checkpoints" / "last.ckpt"
    last.parent.mkdir(parents=True)
    state = {f"network.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state, "network": settings_of(network), "motion": {}}, last)
    own = {"output": str(tmp_path / "run"), "model": {"network": {"class_path": "CSCSR", "init_args": TINY}}}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(own))
    alone = ["predict", words[1], "--frame", "40", "-o", str(tmp_path / "alone")]
    words = [*alone, "-c", str(tmp_path / "own.yaml"), "-o", str(tmp_path / "out")]
    said = refused([*words, "--ckpt_path", "best"])
    assert "best.ckpt: no such checkpoint, there is last.ckpt" in said
    main([*words, "--ckpt_path", "last"])
    main([*alone, "--weights", str(last)])
    assert pictures(tmp_path / "alone") == pictures(tmp_path / "out")
    refused(words, 2)  # without weights
    own["model"]["network"]["init_args"] = {**TINY, "features": 2}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(own))
    assert "was trained with features=1" in refused([*words, "--ckpt_path", "last"])


OWN = """
import torch
from lightning_modules.motion import MotionEstimator
from lightning_modules.networks import Network

class Mean(Network):
    takes_flow = True

    def __init__(self, scale: int = 2, frames: int = 41, gain: float = 1.0, motion: MotionEstimator | None = None):
        settings = {"scale": scale, "frames": frames, "pattern": "RGGB", "alpha": 0.4, "gain": gain}
        super().__init__(settings, (0, frames // 2, frames - 1), motion)
        self.weight = torch.nn.Parameter(torch.ones(()))

    def forward(self, spikes, flow):
        seen = self.weight * spikes.float().mean(dim=1, keepdim=True).expand(-1, 3, -1, -1)
        return seen.repeat_interleave(self.scale, -1).repeat_interleave(self.scale, -2)

class Slowly(MotionEstimator):
    def forward(self, spikes, times, pattern):
        flow = spikes.new_ones(len(spikes), 2, *spikes.shape[-2:], dtype=torch.float32)
        return -flow, flow
"""


def test_own_network_and_estimator_make_pictures(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    (tmp_path / "my_network.py").write_text(OWN)
    (tmp_path / "own.yaml").write_text(
        "model: {network: {class_path: my_network.Mean, init_args: {motion: {class_path: my_network.Slowly}}}}"
    )
    words = ["predict", words[1], "--frame", "40", "-c", "own.yaml", "-o", "out"]
    refused(words, 2)  # no weights
    import my_network

    write_weights(Weights(tmp_path, settings_of(my_network.Mean()), {}, {"weight": torch.tensor(0.5)}), "w.safetensors")
    main([*words, "--weights", "w.safetensors"])
    assert len(pictures(tmp_path / "out")) == 1
    monkeypatch.setenv("HOME", str(tmp_path))
    main(["export", "w.safetensors", "-c", "own.yaml", "-o", "~/copy.safetensors"])
    main(["export", "w.safetensors", "-c", "own.yaml", "--format", "torch", "-o", "copy.pt2"])
    main([*words[:-1], "again", "--weights", "copy.safetensors"])
    assert pictures(tmp_path / "again") == pictures(tmp_path / "out")
    refused(["export", "w.safetensors", "--format", "torch", "-o", "alone.pt2"])


@pytest.mark.slow
def test_ray_makes_the_same_pictures(words, tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="Ray is an extra")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    main([*words, str(tmp_path / "one.mp4")])
    main([*words, str(tmp_path / "many.mp4"), "--engine", "ray", "--jobs", "2"])
    assert (tmp_path / "many.mp4").read_bytes() == (tmp_path / "one.mp4").read_bytes()


def test_mistakes_are_usage_errors(words, tmp_path, capsys):
    for more, said in (
        (["-o", str(tmp_path / "one.png")], "-o: expected a folder or a film for 6 pictures, got"),
        (["--speed", "fast"], "--speed: chooses weights of the package, got -c as well"),
        (["--engine", "ray", "--budget", "2s"], "--budget"),
    ):
        refused([*words, str(tmp_path / "out"), *more], 2)
        assert said in capsys.readouterr().err
