"""``spikekit simulate``: complete and reproducible sets of files, or none."""

import hashlib
import json
import multiprocessing
import os
import threading
from pathlib import Path

import pytest
import torch
from skimage import io

from spikekit import Calibration, read_picture, read_spikes, tfp, write_calibration, write_picture, write_spikes
from spikekit.cli.command import main
from spikekit.io.sidecar import KIND, find_sidecar, published, read_sidecar
from spikekit.scenes.frame_sequence import FrameSequence
from spikekit.sensor.noise import DEAD, HOT

QUICK = ["--scale", "2", "--interpolation", "Blend"]


def frames(count, seed=0):
    """A smooth picture, in multiples of 1/255, that moves to the left by two pixels per frame."""
    noise = torch.rand(1, 3, 5, 8, generator=torch.Generator().manual_seed(seed))
    picture = torch.nn.functional.interpolate(noise, size=(35, 60), mode="bicubic")[0].clamp(0, 1)
    return [(picture.roll(-2 * n, -1)[:, :, :37] * 255).round() / 255 for n in range(count)]


@pytest.fixture
def film(tmp_path, monkeypatch):
    """A folder of five pictures of 35 x 37, which scale 2 crops to 32 x 36."""
    monkeypatch.chdir(tmp_path)
    for n, rgb in enumerate(frames(5)):
        write_picture(f"film/f{n}.png", rgb)
    return Path("film")


def simulate(*words):
    assert main(["simulate", *map(str, words)]) == 0


@pytest.fixture(name="fails")
def _fails(fails):
    """Run a command that must fail and leave all files unchanged."""

    def check(status, *words):
        before = everything()
        said = fails(status, "simulate", *words)
        assert everything() == before
        return said

    return check


def everything():
    """Return the contents of all files below the working folder."""
    return {str(path): path.read_bytes() for path in Path().rglob("*") if path.is_file()}


def believed(stream):
    """Return whether a set of files has a side-car, and then check that it is complete."""
    sidecar = find_sidecar(stream)
    if sidecar is None:
        return False
    assert hashlib.sha256(stream.read_bytes()).hexdigest() == sidecar.stream["sha256"]
    assert all(read_picture(stream.parent / picture).shape[0] == 3 for picture in sidecar.truth)
    return True


# --- a clip -----------------------------------------------------------------------------------------------------------


def test_a_clip_equals_that_of_python(film, capsys):
    simulate(film, "-o", "made/a.dat", "--scale", 2, "--seed", 3, "--pattern", "gbrg", "--frame", 2)
    report, err = capsys.readouterr()
    assert err == ""
    assert "35 x 37 (H x W), cropped to 32 x 36" in report
    assert believed(Path("made/a.dat"))
    known = read_sidecar(Path("made/a.json"))
    assert [known.stream[name] for name in ("frames", "height", "width")] == [41, 16, 18]
    assert known.truth == {"a.png": 20}
    assert known.source == {"path": "film", "frames": ["f1.png", "f2.png", "f3.png"]}
    assert [interval["latent"] for interval in known.plan["intervals"]] == [
        FrameSequence(frames(5), scale=2, pattern="GBRG").plan(n).latent for n in (1, 2)
    ]

    assert (io.imread("made/a.png") == io.imread("film/f2.png")[:32, :36]).all()
    whole = FrameSequence(frames(5), scale=2, pattern="GBRG")
    spikes = read_spikes("made/a.dat", 16, 18)
    assert spikes.equal(torch.cat(list(whole.spikes(20, 41, seed=3))))
    light = whole.light(20, 41).mean(0)
    assert (tfp(spikes, 41)[20] - light).abs().max() < 0.03


def test_a_whole_film_equals_a_single_run_in_bounded_memory(film, capsys):
    """The stream equals that of a single run, every frame has a ground truth, and memory is bounded."""
    simulate(film, "-o", "a.npz", "--all", *QUICK, "--photons", 50)
    assert "left out     nothing" in capsys.readouterr().out
    known = read_sidecar(Path("a.json"))
    assert known.truth == {f"a/f{n}.png": 20 * n for n in range(5)}
    for n in range(5):
        assert (io.imread(f"a/f{n}.png") == io.imread(f"film/f{n}.png")[:32, :36]).all()
    simulate(film, "-o", "b.dat", "--all", *QUICK, "--photons", 50)
    spikes = read_spikes("b.dat", 16, 18)
    assert spikes.shape[0] == 81
    assert spikes.equal(read_spikes("a.npz"))
    assert read_sidecar(Path("b.json")).stream["sha256"] == known.stream["sha256"]
    assert known.plan["intervals"] == [{"latent": 0, "region": None}] * 4


@pytest.mark.parametrize("pattern", ["RGGB", "grey"])
def test_single_picture_is_a_still_scene(film, pattern):
    simulate("film/f1.png", "-o", "a.dat", "--scale", 2, "--pattern", pattern)
    assert believed(Path("a.dat"))
    assert io.imread("a.png").ndim == (2 if pattern == "grey" else 3)
    spikes = read_spikes("a.dat", 16, 18)
    light = FrameSequence(frames(2)[1:], scale=2, pattern=pattern).light()[0]
    assert (spikes.sum(0) - 41 * light).abs().max() < 1


def test_negligible_noise_is_left_out_and_the_plan_can_be_given(film, capsys):
    words = film, "--scale", 2, "--photons", 20, "--dark-current", 1e-9
    for plan, said, dark in (
        ("scene", "left out     dark_current", 0),
        ("everything", "left out     nothing", 1e-9),
        (3, "left out     dark_current", 0),
    ):
        simulate(*words, "-o", "a.dat", "--plan", plan)
        assert said in capsys.readouterr().out
        made = read_sidecar(Path("a.json")).plan
        assert (made["noise"]["dark_current"], made["noise"]["photons"]) == (dark, 20)
        latent = {"everything": {19}, 3: {3}}.get(plan)
        assert latent in (None, {one["latent"] for one in made["intervals"]})


# --- side-cars -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("part", "value", "said"),
    [
        ("source", None, "source: expected names and values, got None"),
        ("stream.frames", True, "stream.frames: expected a whole number >= 1, got True"),
        ("settings.alpha", float("nan"), "settings.alpha: expected a finite number above 0, got nan"),
        ("settings.pattern", "RGB", "settings.pattern: expected one of RGGB, BGGR, GRBG, GBRG, grey, got 'RGB'"),
    ],
    ids=str,
)
def test_a_damaged_sidecar_is_named_in_one_line(tmp_path, monkeypatch, fails, capsys, part, value, said):
    """Every verb that reads it gives a one-line error that names it."""
    monkeypatch.chdir(tmp_path)
    write_spikes("a.dat", torch.ones(3, 4, 8))
    known = {
        "kind": KIND,
        "stream": {"file": "a.dat", "frames": 3, "height": 4, "width": 8, "sha256": ""},
        "truth": {},
        "source": {"path": "film", "frames": {"0.png": ""}},
        "settings": {"scale": 2, "noise": {}},
        "plan": {},
        "versions": {},
    }
    section, _, name = part.partition(".")
    Path("a.json").write_text(json.dumps(known | {section: known[section] | {name: value} if name else value}))
    expected = f"spikekit: a.json: not a readable side-car ({said}"
    for words in (["info"], ["decode", "-o", "a.png"], ["view", "-o", "a.png"]):
        assert main([words[0], "a.dat", *words[1:]]) == 1
        assert capsys.readouterr().err.startswith(expected)
    assert main(["info", "a.dat", "--height", "4", "--width", "8"]) == 0  # without it


def test_two_processes_with_one_output_give_the_same_files(film):
    """Concurrent processes with one output, and a process with all threads, give the same files."""
    words = ["simulate", str(film), *QUICK, "--photons", "30", "-o", "a.dat"]
    with multiprocessing.get_context("fork").Pool(2) as pool:
        assert pool.map(main, [words] * 2) == [0] * 2
    assert believed(Path("a.dat"))
    assert not list(Path().glob(".*"))
    at_once = {name: Path(name).read_bytes() for name in ("a.dat", "a.png", "a.json")}
    for name in at_once:
        Path(name).unlink()
    assert main(words) == 0
    assert {name: Path(name).read_bytes() for name in at_once} == at_once


# --- whole or not at all ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0, 1, 4, 6, 7])
def test_a_process_killed_while_publishing_leaves_one_set_of_files(film, monkeypatch, step):
    """After every step, the files are the old set, the new set, or a set without side-car."""
    simulate(film, "-o", "a.dat", "--all", *QUICK)
    old = Path("a.dat").read_bytes()
    moves = iter(range(100))
    replace = os.replace

    def dies(*paths):
        if str(paths[0]).count(".part") == 1 and next(moves) == step:
            raise KeyboardInterrupt
        replace(*paths)

    monkeypatch.setattr("spikekit.io.sidecar.os.replace", dies)
    status = main(["simulate", str(film), "-o", "a.dat", "--all", *QUICK, "--seed", "1"])
    assert status == (130 if step < 7 else 0)
    assert believed(Path("a.dat")) == (step == 7)
    assert (Path("a.dat").read_bytes() == old) == (step == 0)


def test_leftovers_are_removed_and_a_second_process_waits(film):
    Path(".a.json.part/killed").mkdir(parents=True)
    done = []
    with published(Path("a.dat")) as running:
        assert [path.name for path in Path(".a.json.part").iterdir()] == [running.name]
        other = threading.Thread(target=lambda: (simulate(film, "-o", "a.dat", *QUICK), done.append(1)))
        other.start()
        other.join(1)
        assert not done
    other.join()
    assert not list(Path().glob(".*"))
    assert believed(Path("a.dat"))


@pytest.mark.parametrize(("room", "words", "name"), [(8000, ["--all", "--clocks", "200"], "a.dat"), (500, [], "a.png")])
def test_a_full_disk_gives_one_line_and_keeps_old_files(film, fails, full_disk, room, words, name):
    """The error is one line that names the file; existing files are kept."""
    simulate(film, "-o", "a.dat", *QUICK)
    with full_disk(room):
        said = fails(1, film, "-o", "a.dat", *QUICK, *words)
    assert said == f"spikekit: {name}: File too large\n"
    assert not list(Path().glob(".*"))


def test_other_files_are_not_overwritten(film, fails):
    simulate(film, "-o", "a.dat", *QUICK)
    Path("b.json").write_text("{}")
    Path("c.dat").mkdir()
    write_picture("d.png", torch.zeros(3, 4, 4))
    Path("elsewhere").mkdir()
    Path("e").symlink_to("elsewhere")
    for words, said in (
        ((film, "-o", "film.dat", "--all"), "its ground truth film/f0.png would overwrite the source"),
        (("film/f1.png", "-o", "film/f1.dat"), "would overwrite the source"),
        ((film, "-o", "a.npz"), "a.npz: its side-car a.json would overwrite that of a.dat"),
        ((film, "-o", "b.dat"), "b.json: not a readable side-car"),
        ((film, "-o", "c.dat"), "c.dat: expected a file, got a folder"),
        ((film, "-o", "d.dat"), "d.png: exists and is not a ground truth"),
        ((film, "-o", "e.dat", "--all"), "e: expected a folder, got a link"),
    ):
        assert said in fails(1, *words, *QUICK)


# --- awkward input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (
            ["film", "--scale", "2", "--frame", "0"],
            2,
            "--frame: a clip of 41 clocks",
        ),
        (["film", "--scale", "2", "--frames", "401"], 2, "--frame: a clip of 401 clocks"),
        (["film", "--scale", "2", "--all", "--frame", "1"], 2, "--frame: expected none with the whole film, got 1"),
        (["film", "--scale", "20"], 1, "film: frames: expected 40 x 40 pixels or more, got 35 x 37"),
        (["film"], 2, "--scale"),
        (["film", "--scale", "2", "--plan", "many"], 2, "expected scene, everything or a number of latent frames"),
        (["film", "--scale", "2", "--dark-current", "-1"], 2, "--dark-current: expected 0 to 1, got -1.0"),
        (["film/f0.png", "--scale", "2", "--all"], 2, "is a single picture"),
        (["damaged", "--scale", "2"], 1, "damaged/0.png: not a readable picture"),
        (["nothing", "--scale", "2"], 1, "nothing: no such file or folder"),
    ],
)
def test_mistakes_give_one_line(film, fails, words, status, said):
    Path("damaged").mkdir()
    Path("damaged/0.png").write_bytes(Path("film/f4.png").read_bytes()[:150])
    assert said in fails(status, *words, "-o", "a.dat")


def calibrated(path, width=18):
    """A sensor with gain 0.5 in its left half, a dead pixel and a hot one."""
    gains, defects = torch.ones(16, width), torch.zeros(16, width, dtype=torch.uint8)
    gains[:, : width // 2] = 0.5
    defects[3, 5], defects[4, 6] = DEAD, HOT
    write_calibration(path, Calibration(gains, torch.zeros(16, width), defects))


def test_pixels_of_a_calibrated_sensor_are_simulated(film, fails):
    Path("cameras").mkdir()
    calibrated("cameras/one.safetensors")
    words = [film, "--frames", 400, "--frame", 2, "--clocks", 200, "--alpha", 0.8, *QUICK]
    sensor = ["--calibration", "cameras/one.safetensors"]
    simulate(*words, "-o", "plain.dat")
    simulate(*words, *sensor, "--photons", 1e6, "-o", "out/real.dat")
    plain, real = (read_spikes(path, 16, 18).float().mean(0) for path in ("plain.dat", "out/real.dat"))
    assert real[3, 5] == 0
    assert real[4, 6] == 1
    works = torch.ones(16, 18, dtype=bool)
    works[3, 5] = works[4, 6] = False
    expected = torch.where(torch.arange(18) < 9, plain / 2, plain)
    assert (real - expected)[works].abs().max() < 0.02
    assert read_sidecar(Path("out/real.json")).settings["calibration"] == "cameras/one.safetensors"
    calibrated("cameras/one.safetensors", width=20)
    said = "one.safetensors: expected 16 x 18 pixels, as in the film, got 16 x 20"
    assert said in fails(1, *words, *sensor, "-o", "a.dat")
