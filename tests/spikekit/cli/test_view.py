"""``spikekit view``, and the metadata from side-cars and cameras."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from spikekit import (
    Layer,
    Motion,
    Scene,
    read_picture,
    read_spikes,
    recording,
    simulate_spikes,
    tfi,
    tfp,
    write_picture,
    write_spikes,
)
from spikekit.cli.command import main
from spikekit.cli.view import Moment

PATTERN = "RGGB"


def view(*words):
    assert main(["view", *map(str, words)]) == 0


@pytest.fixture
def moving(tmp_path, monkeypatch):
    """A colour recording of 101 frames of 40 x 48: a smooth picture that moves to the right by 0.1 pixels per frame."""
    monkeypatch.chdir(tmp_path)
    noise = torch.rand(1, 3, 9, 15, generator=torch.Generator().manual_seed(1))
    picture = torch.nn.functional.interpolate(noise, size=(60, 100), mode="bicubic")[0].clamp(0, 1)
    scene = Scene([Layer(picture, Motion((0.1, 0.0)), (-10, -20))], 40, 48, 101)
    write_spikes("a.dat", simulate_spikes(scene.light(PATTERN, scale=1, alpha=0.5)))
    return scene


@pytest.fixture
def still(tmp_path, monkeypatch):
    """A simulated stream with its side-car: left half red, right half blue."""
    monkeypatch.chdir(tmp_path)
    picture = torch.zeros(3, 32, 48)
    picture[0, :, :24] = picture[2, :, 24:] = 1
    write_picture("photo.png", picture)
    assert main(["simulate", "photo.png", "-o", "a.dat", "--scale", "1", "--pattern", "GBRG", "--alpha", "0.5"]) == 0
    return picture


def moment(path, **known):
    frames, size = (known.pop("frames"), known.pop("size"))
    shown = recording.Recording(Path(path), frames, size, **known)
    return Moment(shown, 0, frames, 41, 0.5)


# --- what is shown ----------------------------------------------------------------------------------------------------


def test_pictures_equal_those_of_the_decoders(moving):
    """TFP and TFI of the middle frame, motion, and the spikes of a row."""
    here = moment("a.dat", frames=101, size=(40, 48))
    spikes = read_spikes("a.dat", 40, 48)
    assert here.tfp().equal((tfp(spikes, 41)[50] / 0.5).clamp(0, 1))
    assert here.tfi().equal((tfi(spikes)[50] / 0.5).clamp(0, 1))
    assert here.raster().equal(spikes[:, 20].T)
    part = Moment(here.recording, 10, 60, 41, 0.5)
    assert part.raster().equal(spikes[10:60, 20].T)
    assert part.tfp().equal((spikes[15:56].float().mean(0) / 0.5).clamp(0, 1))
    colours, longest, length = here.motion()
    assert length == 20
    assert longest == pytest.approx(2, abs=0.8)  # a tenth of a pixel a frame
    red, green, blue = colours[:, 15:25, 15:33].flatten(1).median(dim=1).values
    assert red > 0.99  # to the right
    assert max(green, blue) < 0.6


def test_metadata_come_from_the_sidecar(still, capsys):
    """Size, Bayer phase and alpha are read, so the colours are those of the scene."""
    capsys.readouterr()
    view("a.dat", "-o", "made/a.png", "--window", 5, "--frames", "10:30")
    assert capsys.readouterr().out == "made/a.png: frames 10 .. 29 of 41, white: alpha 0.5\n"
    view("a.dat", "-o", "made/a.png")
    tfp, *_ = read_picture("made/a.png")[:, :450].split(533, dim=-1)
    red, blue = (tfp[channel] - tfp[1] > 0.9 for channel in (0, 2))
    assert red.sum() > 10_000
    assert blue.sum() == pytest.approx(int(red.sum()), rel=0.1)
    assert red.nonzero()[:, 1].max() < blue.nonzero()[:, 1].min()
    assert main(["decode", "a.dat", "--method", "tfp", "-o", "d.png"]) == 0
    assert read_picture("d.png")[:, 16, 8].tolist() == pytest.approx([1, 0, 0], abs=0.1)


@pytest.mark.parametrize(("shape", "value"), [((1, 1, 1), 0), ((1, 1, 1), 1), ((30, 40, 40), 0)])
def test_dim_short_and_small_recordings_give_a_picture(tmp_path, monkeypatch, shape, value):
    """A few pixels, one frame, no spikes or only spikes still give a picture."""
    monkeypatch.chdir(tmp_path)
    write_spikes("a.npz", torch.full(shape, value))
    view("a.npz", "-o", "a.png", "--pattern", "RGGB")
    assert read_picture("a.png").shape == (3, 900, 1600)


# --- what is known of a recording -------------------------------------------------------------------------------------


@pytest.mark.parametrize("header", [True, False])
def test_camera_sets_size_flip_and_crop(tmp_path, monkeypatch, capsys, header):
    """Every verb drops the header columns, flips the frames and crops the border."""
    monkeypatch.chdir(tmp_path)
    known = {
        "title": "a small one", "height": 6, "width": 8, "drop": [[3, 5]], "rate": 20000, "flip": True,
        "pattern": "BGGR", "crop": [1, 1, 1, 1], "gain": 1.5, "gamma": 2.0, "source": "made up",
    }  # fmt: skip
    Path("own.json").write_text(json.dumps(known))
    light = torch.rand(6, 8) * 0.4 + 0.1
    spikes = simulate_spikes(light.expand(400, 6, 8)).flip(-2)
    if header:
        spikes = torch.cat([spikes[..., :3], torch.ones(400, 6, 2, dtype=torch.uint8), spikes[..., 3:]], -1)
    write_spikes("a.dat", spikes)
    assert main(["info", "a.dat", "--camera", "own.json"]) == 0
    out = capsys.readouterr().out
    assert "size         4 x 6 (H x W)" in out
    assert "always fire  0 of 24 pixels" in out
    inner = light[1:-1, 1:-1]
    place = divmod(int(inner.argmax()), 6)
    assert f"at row {place[0]}, column {place[1]}" in out.split("brightest")[1]

    words = ["a.dat", "--camera", "own.json", "--alpha", "1"]
    assert main(["decode", *words, "--method", "tfp", "--window", "399", "-o", "d.png"]) == 0
    shown = read_picture("d.png")
    known = torch.zeros(4, 6)
    known[::2, ::2], known[1::2, 1::2] = shown[0, ::2, ::2], shown[2, 1::2, 1::2]  # RGGB after the crop
    known[::2, 1::2], known[1::2, ::2] = shown[1, ::2, 1::2], shown[1, 1::2, ::2]
    assert (known - (1.5 * inner).sqrt()).abs().max() < 0.01
    shown = recording.open_recording("a.dat", camera="own.json")
    assert next(shown.frames_from(7)).equal(shown.camera.prepare(spikes[7]))
    assert (shown.unpack(next(shown.packed(7, 1))) == next(shown.frames_from(7)).numpy()).all()


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["a.dat", "--camera", "vidar", "--width", "400"], 2, "--camera: it sets --height, --width and --flip"),
        (["a.dat", "--camera", "vidar"], 1, "a.dat: truncated, or not 250 x 4"),
        (["b.dat"], 1, "b.dat: expected 41 frames, as in its side-car, got 40"),
        (["a.dat", "--frames", "40:42"], 2, "--frames: expected frames within 0 .. 40, got 40:42"),
    ],
)
def test_mistakes_give_one_line(still, fails, words, status, said):
    Path("b.dat").write_bytes(Path("a.dat").read_bytes()[:-192])
    Path("b.json").write_text(Path("a.json").read_text().replace("a.dat", "b.dat"))
    assert said in fails(status, "view", *words, "-o", "out.png")
    assert not Path("out.png").exists()


@pytest.mark.parametrize("words", [["view", "a.dat"], ["decode", "a.dat"], ["view", "b.dat"], ["view", "sub/../a.dat"]])
def test_files_of_a_sidecar_are_not_overwritten(still, capsys, words):
    shutil.copy("a.dat", "b.dat")
    Path("sub").mkdir()
    truth = Path("a.png").read_bytes()
    size = ["--height", "32", "--width", "48"]
    for given in (size,) if words[1] == "b.dat" else (size, []):
        assert main([*words, *given, "-o", "a.png"]) == 1
        assert "a.png: would overwrite the ground truth of a.json" in capsys.readouterr().err
    assert Path("a.png").read_bytes() == truth
