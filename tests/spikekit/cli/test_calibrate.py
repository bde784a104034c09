"""``spikekit calibrate``: the calibration is measured, stored, and applied by the commands that decode."""

import os
import re

import pytest
import torch
from safetensors.torch import save_file

from spikekit import Calibration, SensorNoise, SpikeSensor, read_calibration, read_picture
from spikekit import write_spikes as write
from spikekit.calibration.calibration import ENDING
from spikekit.cli.command import main
from spikekit.recording import open_recording
from spikekit.sensor.noise import DEAD, HOT

SIZE = 24, 32
HOW = ["--height", "24", "--width", "32", "--flip", "--pattern", "BGGR"]


@pytest.fixture(name="truth", scope="module")
def _truth():
    defects = torch.zeros(SIZE, dtype=torch.uint8)
    defects[5, 7], defects[20, 3] = DEAD, HOT
    gain = 1 + 0.1 * torch.randn(SIZE, generator=torch.Generator().manual_seed(0)).clamp(-2, 2)
    return Calibration(gain, torch.full(SIZE, 0.01), defects)


@pytest.fixture(name="folder", scope="module")
def _folder(tmp_path_factory, truth):
    """Recordings of a wall, of a scene and in the dark, by a camera that stores frames upside down."""
    folder, sensor = tmp_path_factory.mktemp("camera"), SpikeSensor(SensorNoise(calibration=truth))
    write(folder / "wall.dat", sensor.expose(torch.full((300, *SIZE), 0.3)), flip=True)
    write(folder / "cap.dat", sensor.expose(torch.zeros(500, *SIZE)), flip=True)
    write(folder / "scene.dat", sensor.expose(torch.linspace(0.1, 0.4, 32).expand(300, *SIZE)), flip=True)
    return folder


@pytest.fixture(autouse=True)
def _camera(folder, monkeypatch):
    monkeypatch.chdir(folder)
    for left in {*folder.glob("*.safetensors"), *folder.glob("*.png")}:
        left.unlink()


def measured():
    assert main(["calibrate", "scene.dat", *HOW, "--flat", "wall.dat", "--dark", "cap.dat"]) == 0


def test_calibration_is_stored_beside_the_recording_and_reported(capsys, truth):
    measured()
    said = capsys.readouterr().out
    assert "gain         SD 9." in said
    assert "dark rate    0.01 spikes per frame" in said
    assert "dead         1 of 768 pixels\nhot          1 of 768 pixels" in said
    assert "scene.calibration.safetensors: flat 300 frames, dark 500 frames" in said
    assert read_calibration(f"scene{ENDING}").flip().defects.equal(truth.defects), "rows as they are stored"
    assert main(["info", "scene.dat", "--height", "24", "--width", "32"]) == 0
    assert re.search(r"gain SD 9\.\d+%, dark rate 0\.01 spikes per frame, 2 defects", capsys.readouterr().out)
    assert main(["info", "scene.dat", "--height", "32", "--width", "24"]) == 1
    assert "scene.dat: expected 24 x 32 pixels, the size of scene.calibration" in (said := capsys.readouterr().err)
    assert said.endswith("got 32 x 24; height and width may be swapped\n")
    for flip in (False, True):
        wall = open_recording("wall.dat", height=24, width=32, flip=flip, calibration=f"scene{ENDING}")
        assert wall.calibration.defects.equal(truth.defects if flip else truth.defects.flip(0))


@pytest.mark.parametrize("command", [["decode", "--method", "tfp"], ["decode", "--method", "tfi"], ["view"]])
def test_pictures_are_corrected(command, capsys):
    verb, *method = command
    run = [verb, "scene.dat", *HOW, *method, "--alpha", "0.4"]
    assert main([*run, "-o", "before.png"]) == 0
    assert "corrected" not in capsys.readouterr().out
    measured()
    assert main([*run, "-o", "after.png"]) == 0
    assert "pixels corrected by its calibration" in capsys.readouterr().out
    assert main([*run, "--calibration", "none", "-o", "without.png"]) == 0
    assert read_picture("without.png").equal(read_picture("before.png"))
    if verb == "decode":
        ramp = torch.linspace(0.25, 1, 32).expand(3, *SIZE)
        error, corrected = ((read_picture(f"{name}.png") - ramp).square().mean() for name in ("before", "after"))
        assert corrected < error * (0.4 if "tfp" in method else 0.7)  # light between 1/2 and 1/3 is rounded by tfi


def test_defects_are_found_in_a_scene(capsys, truth):
    assert main(["calibrate", "scene.dat", *HOW, "-o", "alone.safetensors"]) == 0
    assert main(["info", "scene.dat", *HOW, "--calibration", "alone.safetensors"]) == 0
    assert read_calibration("alone.safetensors").flip().defects.equal(truth.defects)
    assert re.search(r"gain +not measured in 300 frames: too (.|\n)*gain not measured, dark", capsys.readouterr().out)


def test_gains_are_found_in_a_moving_scene(capsys, truth):
    y, x, t = torch.meshgrid(torch.arange(24), torch.arange(32), torch.arange(400), indexing="ij")
    across, down = x - 0.06 * t, y - 0.04 * t
    light = 0.25 + sum(
        0.03 * torch.sin(across * u + down * v + n)
        for n, (u, v) in enumerate([(0.3, 0.1), (-0.2, 0.5), (0.7, -0.4), (0.1, 0.8)])
    )
    sensor = SpikeSensor(SensorNoise(calibration=truth))
    write("moving.dat", sensor.expose(light.movedim(-1, 0)), flip=True)
    assert main(["calibrate", "moving.dat", *HOW]) == 0
    assert re.search(r"^gain +SD \d\.\d+%, error \d\.\d+%$", capsys.readouterr().out, re.MULTILINE)
    found, works = read_calibration(f"moving{ENDING}").flip(), truth.defects == 0
    assert found.defects.equal(truth.defects)
    assert torch.corrcoef(torch.stack([found.gain[works], truth.gain[works]]))[0, 1] > 0.8


@pytest.mark.parametrize(
    ("args", "status", "said"),
    [
        (["scene.dat", *HOW, "--flat", "wall.dat", "--dark", "scene.dat"], 1, "wall.dat: expected a flat recording"),
        (["scene.dat", *HOW, "--dark", "wall.dat"], 1, "wall.dat: expected a dark recording, at most 0.1 spikes"),
        (["scene.dat", *HOW, "--flat", "none.dat"], 1, "none.dat: no such file"),
        (["scene.dat", *HOW, "-o", "a.npz"], 2, "--output: expected a name that ends in .safetensors, got a.npz"),
        (["scene.dat", *HOW, "-o", "weights.safetensors"], 1, "weights.safetensors: exists and is not a calibration"),
        (["short.npz"], 1, "short.npz: expected at least 100 frames, got 50"),
        (["wide.npz", "--flat", "short.npz"], 1, "short.npz: expected 8 x 10 pixels, the size of wide.npz, got 8 x 8"),
    ],
)
def test_errors_are_one_line(args, status, said, fails):
    save_file({"weight": torch.ones(3)}, "weights.safetensors")
    write("short.npz", torch.ones(50, 8, 8, dtype=torch.uint8))
    write("wide.npz", torch.ones(200, 8, 10, dtype=torch.uint8))
    assert fails(status, "calibrate", *args).startswith(f"spikekit: {said}")


# Files from strangers


def planes(size=SIZE, **changed):
    good = {"gain": torch.ones(size), "dark": torch.zeros(size), "defects": torch.zeros(size, dtype=torch.uint8)}
    return good | changed


KIND = {"kind": "spikekit calibration 1"}


@pytest.mark.parametrize(
    ("tensors", "metadata", "said"),
    [
        (planes(), None, "expected spikekit calibration 1, got None"),
        (planes((24, 30)), KIND, "expected 24 x 32 pixels, the size of scene.dat, got 24 x 30"),
        (planes(defects=torch.full(SIZE, 9, dtype=torch.uint8)), KIND, "defects: expected 0 to 2, got 9"),
    ],
    ids=lambda value: "",
)
def test_invalid_calibration_files_are_named_in_one_line(tensors, metadata, said, fails):
    save_file(tensors, "bad.safetensors", metadata)
    error = fails(1, "decode", "scene.dat", *HOW, "-o", "x.png", "--calibration", "bad.safetensors")
    assert error.startswith("spikekit: bad.safetensors: ")
    assert said in error
    assert not os.path.exists("x.png")
