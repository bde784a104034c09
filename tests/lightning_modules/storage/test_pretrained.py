"""Weights in files, from Python and as they are typed."""

import csv
import json
import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from lightning_modules.__main__ import main
from lightning_modules.cli.command import run
from lightning_modules.cli.rehearsal import Rehearsal
from lightning_modules.motion import ClassicalFlow, Spike2Flow, ZeroFlow
from lightning_modules.networks import CSCSR, ClassicalDecoder
from lightning_modules.storage.pretrained import load_weights, read_weights, write_weights
from lightning_modules.storage.shipped import FOLDER, list_pretrained, shipped_weights
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import read_picture, write_picture, write_spikes

TINY = {"scale": 2, "width": 4, "representation_width": 4, "features": 1, "stages": 1, "end_blocks": 1, "skip": True}
FLOW_TINY = {"window": 5, "widths": (4,), "features": 4, "hidden": 4, "correlation": (4, 4), "motion": 4, "head": 4}
SPIKES = torch.rand(1, 41, 8, 10, generator=torch.Generator().manual_seed(0)) < 0.3


def network(**changes):
    torch.manual_seed(0)
    made = CSCSR(**{**TINY, **changes})
    torch.nn.init.normal_(made.reconstruction.rgb.weight, std=0.1)  # the skip begins with zeros, as any network would
    return made


def checkpoint(path, module):
    content = {"state_dict": module.state_dict()}
    module.on_save_checkpoint(content)
    torch.save(content, path)
    return path


@pytest.fixture(name="file")
def _file(tmp_path):
    trained = checkpoint(tmp_path / "trained.ckpt", SuperResolution(network()))
    main(["export", str(trained), "-o", str(tmp_path / "trained.safetensors")])
    return tmp_path / "trained.safetensors"


def test_export_and_from_pretrained(file, capsys):
    for source in (file, str(file), file.with_suffix(".ckpt")):
        read = CSCSR.from_pretrained(source)
        assert not read.training
        assert isinstance(read.motion, ClassicalFlow)
        assert torch.equal(read(SPIKES), network()(SPIKES))
    assert isinstance(CSCSR.from_pretrained(file, motion=ZeroFlow()).motion, ZeroFlow)


def test_weights_serve_cameras_of_another_gain(file):
    """The same spikes of a camera of half as much gain again are of a scene two thirds as bright."""
    own, other = CSCSR.from_pretrained(file), CSCSR.from_pretrained(file, alpha=0.6)
    assert [own.settings["alpha"], other.settings["alpha"]] == [0.4, 0.6]
    torch.testing.assert_close(other(SPIKES), own(SPIKES) * (0.4 / 0.6))


@pytest.mark.skipif(os.name != "posix", reason="modes of files are those of POSIX")
def test_others_may_read_what_was_exported(file):
    (file.parent / "any").touch()
    assert file.stat().st_mode == (file.parent / "any").stat().st_mode


@pytest.mark.parametrize("suffix", [".ckpt", ".safetensors"])
def test_learned_motion_is_part_of_the_weights(tmp_path, suffix):
    made = network(motion=Spike2Flow(**FLOW_TINY))
    path = checkpoint(tmp_path / "moved.ckpt", SuperResolution(made))
    if suffix == ".safetensors":
        write_weights(read_weights(path), path.with_suffix(suffix))
    read = CSCSR.from_pretrained(path.with_suffix(suffix))
    assert isinstance(read.motion, Spike2Flow)
    assert torch.equal(read(SPIKES), made(SPIKES))
    with_other = CSCSR.from_pretrained(path.with_suffix(suffix), motion=ZeroFlow())
    torch.testing.assert_close(with_other(SPIKES), made(SPIKES, torch.zeros(1, 2, 2, 8, 10)))
    mine = Spike2Flow(**FLOW_TINY)
    before = {name: value.clone() for name, value in mine.state_dict().items()}
    assert CSCSR.from_pretrained(path.with_suffix(suffix), motion=mine).motion is mine
    assert all(torch.equal(value, before[name]) for name, value in mine.state_dict().items())


@pytest.mark.parametrize("fusion", ["independent", "assembled"])
def test_weights_serve_with_any_way_of_joining_motion(fusion, file):
    other = network(motion_fusion=fusion, motion=ZeroFlow())
    load_weights(other, read_weights(file))
    assert other.config.motion_fusion == fusion
    torch.testing.assert_close(other(SPIKES), network(motion=ZeroFlow())(SPIKES))


def test_a_file_names_no_class_from_outside_the_package(tmp_path):
    outside = type("Foreign", (CSCSR,), {})
    found = read_weights("cscsr_tiny_x4")
    path = tmp_path / "foreign.safetensors"
    write_weights(replace(found, settings={**found.settings, "class": "Foreign"}), path)
    with pytest.raises(ValueError, match="expected weights of CSCSR, got those of Foreign"):
        CSCSR.from_pretrained(path)
    assert isinstance(outside.from_pretrained(path), outside)  # by its own name


def test_weights_of_something_else(file, tmp_path):
    with pytest.raises(ValueError, match="expected weights of ClassicalDecoder, got those of CSCSR"):
        ClassicalDecoder.from_pretrained(file)
    with pytest.raises(ValueError, match=r"trained with scale=2, width=4; this run asks for scale=4, width=8"):
        SuperResolution(network(scale=4, width=8), weights=str(file))
    with pytest.raises(FileNotFoundError, match=r"x9-z: neither a file .* nor .* in the package \(.*spike2flow"):
        CSCSR.from_pretrained("x9-z")
    plain = tmp_path / "plain.safetensors"
    save_file(load_file(file), plain)
    with pytest.raises(ValueError, match=r"plain.safetensors: does not say what network it is of"):
        CSCSR.from_pretrained(plain)
    tensors, said = load_file(file), {"network": json.dumps({"class": "CSCSR", **network().settings}), "motion": "{}"}
    tensors["reconstruction.rgb.weight"] = tensors["reconstruction.rgb.weight"][:1].clone()
    save_file(tensors, plain, said)
    with pytest.raises(ValueError, match=r"plain.safetensors: weights that do not fit .*rgb.weight"):
        CSCSR.from_pretrained(plain)
    save_file(tensors, plain, {**said, "network": json.dumps({"class": "CSCSR", "of_next_year": 1})})
    with pytest.raises(ValueError, match="of_next_year"):
        CSCSR.from_pretrained(plain)
    with pytest.raises(ValueError, match=r"ends in .safetensors"):
        write_weights(read_weights(file), tmp_path / "file.bin")


@pytest.mark.parametrize("suffix", [".ckpt", ".safetensors"])
@pytest.mark.parametrize("length", [0, 5, 1000, -1])
def test_damaged_files_say_so_in_one_line(file, suffix, length, capsys):
    path = file.with_suffix(suffix)
    path.write_bytes(path.read_bytes()[:length])
    for args in (["predict", "--model.weights", str(path)], ["export", str(path), "-o", "other.safetensors"]):
        with pytest.raises(SystemExit) as stopped:
            main(args)
        assert str(stopped.value).startswith(f"lightning: {path}: not a ")
        assert str(stopped.value).count("\n") == 0


def test_loading_runs_no_code(tmp_path):
    class Harmful:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harmed"),)

    for name in ("file.ckpt", "file.safetensors"):
        torch.save({"network": {"class": "CSCSR"}, "state_dict": {}, "other": Harmful()}, tmp_path / name)
        with pytest.raises(ValueError, match=name):
            CSCSR.from_pretrained(tmp_path / name)
    assert not (tmp_path / "harmed").exists()


def test_classes_of_a_file_are_names_and_no_paths(tmp_path):
    """A path would be imported where the network is built, and a module runs when it is imported."""
    said = {"class": "this.That", **network().settings}
    torch.save({"network": said, "state_dict": {}}, tmp_path / "file.ckpt")
    save_file(
        load_file(shipped_weights()["cscsr_tiny_x4"]),
        tmp_path / "file.safetensors",
        {"network": json.dumps(said), "motion": "{}"},
    )
    for name in ("file.ckpt", "file.safetensors"):
        with pytest.raises(ValueError, match=name):
            read_weights(tmp_path / name)


@pytest.mark.parametrize(
    "changes",
    [
        {"motion": None},
        {"state_dict": {1: torch.zeros(1)}},
        {"state_dict": {"a": "b"}},
        {"network": {"scale": torch.ones(1)}},
    ],
)
def test_odd_checkpoints_say_so(tmp_path, changes):
    torch.save({"network": {"class": "CSCSR"}, "state_dict": {}, **changes}, tmp_path / "odd.ckpt")
    with pytest.raises(ValueError, match=r"odd.ckpt: not a checkpoint of lightning fit"):
        read_weights(tmp_path / "odd.ckpt")


def test_motion_of_no_class_is_refused(file, tmp_path):
    said = {"network": json.dumps({"class": "CSCSR", **network().settings}), "motion": json.dumps({"window": 11})}
    save_file(load_file(file), tmp_path / "odd.safetensors", said)
    with pytest.raises(ValueError, match=r"odd.safetensors: class: expected one of ClassicalFlow, .*, got None"):
        CSCSR.from_pretrained(tmp_path / "odd.safetensors")


def test_weights_that_share_memory_can_be_exported(tmp_path):
    shared = torch.zeros(3)
    found = read_weights("cscsr_tiny_x4")
    write_weights(replace(found, tensors={"a": shared, "b": shared}), tmp_path / "shared.safetensors")
    assert set(load_file(tmp_path / "shared.safetensors")) == {"a", "b"}


def test_a_module_can_be_pickled():
    module = SuperResolution.from_pretrained(speed="fastest")
    spikes = torch.ones(1, 41, 8, 8)
    assert torch.equal(pickle.loads(pickle.dumps(module))(spikes), module(spikes))


def test_shipped_weights_are_what_their_names_and_cards_say():
    assert "spike2flow" in shipped_weights()
    for name, path in shipped_weights().items():
        assert path.stat().st_size < 16 * 2**20
        assert path.with_name(f"{name}.md").is_file(), f"{name} has no card"
        found = read_weights(name)
        if name == "spike2flow":
            Spike2Flow(weights=name)
            continue
        assert found.settings["class"] == ("RecurrentCSCSR" if "_film_" in name else "CSCSR")
        assert name.endswith(f"_x{found.settings['scale']}")
        network = CSCSR.from_pretrained(name)
        built = {"class": type(network).__name__, **network.settings}
        assert {key: built[key] for key in found.settings} == found.settings


SHIPPED_ONCE = ["x2-e", "x2-d", "x2-w", "x3-e", "x3-d", "x3-w", "x4-t", "x4-e", "x4-d", "x4-w", "x4-h", "spike2flow"]


def test_every_file_of_weights_is_in_the_index_and_loads_by_every_name_it_had():
    assert set(FOLDER.glob("*.safetensors")) == set(shipped_weights().values())
    for former in SHIPPED_ONCE:
        (name,) = [weights.name for weights in list_pretrained() if former in (weights.name, weights.former)]
        assert read_weights(former).source == read_weights(name).source == shipped_weights()[name]
    with pytest.raises(FileNotFoundError, match=r"^x4-q: neither a file of weights nor .* \(cscsr_small_x2, "):
        read_weights("x4-q")


@pytest.mark.parametrize(
    "film", [weights for weights in list_pretrained() if weights.film], ids=lambda weights: weights.name
)
def test_a_network_for_films_shares_its_file_with_the_one_that_it_contains(film):
    (inside,) = [weights for weights in list_pretrained() if weights.path == film.path and weights != film] or [None]
    if inside is None:
        return
    assert inside.parameters == sum(value.numel() for value in CSCSR.from_pretrained(inside.name).parameters())
    assert inside.parameters < film.parameters
    spikes = (torch.rand(1, inside.frames, 12, 10) < 0.3).to(torch.uint8)
    clip, both = CSCSR.from_pretrained(inside.name), CSCSR.from_pretrained(film.name)
    assert type(clip) is CSCSR
    assert torch.equal(clip(spikes, static=True), both(spikes, static=True))


def _rows_of_card(path):
    """The tables of a card: rows by their first cell, each a dictionary by the heading."""
    rows, heading = {}, []
    for line in path.read_text().splitlines():
        cells = [cell.strip(" *") for cell in line.strip("|").split("|")]
        if line.startswith("| `lightning test"):
            heading = cells
        elif line.startswith("| "):
            rows[cells[0]] = dict(zip(heading, cells, strict=False))
    return rows


@pytest.mark.parametrize("weights", list_pretrained(), ids=lambda weights: weights.name)
def test_what_is_listed_is_what_cards_and_tables_say(weights):
    card = weights.path.with_name(f"{weights.name}.md")
    said = re.search(r"([\d.]+)\s+MMAC a sensor", card.read_text())
    assert not said or float(said[1]) == pytest.approx(weights.macs / 1e6, abs=0.005)
    if not weights.scale:
        return
    rows = _rows_of_card(card)
    beginnings = {
        "kodak": ("Kodak, 24 stills in motion", "Kodak, up to 3 in 20 clocks"),
        "vid4": ("Vid4, foliage and walk only, 20 clocks a frame",),
    }
    for name, begin in beginnings.items():
        (score,) = [row[weights.name] for first, row in rows.items() if first.startswith(begin)]
        assert float(score) == getattr(weights, name)
    with open(FOLDER / f"x{weights.scale}.csv", newline="") as file:
        measured = {row["setting"]: row for row in csv.DictReader(file)}
    if weights.name in measured:
        assert float(measured[weights.name]["macs"]) == pytest.approx(weights.macs, rel=1e-5)


def test_the_list_of_weights_says_what_the_networks_are(configs):
    import lightning_modules

    listed = lightning_modules.list_pretrained()
    assert [weights.name for weights in listed] == list(shipped_weights())
    assert [weights.size for weights in lightning_modules.list_pretrained(4)] == [
        "tiny",
        "small",
        "base",
        "large",
        "huge",
        "huge",
        "huge_long",
        "huge_long",
        "large_film",
        "huge_deep_film",
        "huge_deep_film",
        "huge_long_deep_film",
        "huge_long_deep_film",
    ]
    for weights in listed:
        found = read_weights(weights.name)
        assert weights.parameters == sum(value.numel() for value in found.tensors.values())
        assert weights.scale == found.settings.get("scale")
        if weights.scale:
            assert min(weights.macs, weights.kodak, weights.vid4) > 0
            overlay = yaml.safe_load((configs / f"size/{weights.size}.yaml").read_text())
            assert overlay["model"]["network"]["init_args"].items() <= found.settings.items()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["argument", "configuration"])
def test_predict_needs_nothing_but_weights(file, how, tmp_path, monkeypatch, capfd):
    """From elsewhere, and once in a process of its own: nothing but the package and the file of weights is needed."""
    monkeypatch.setattr(sys, "argv", ["lightning"])
    monkeypatch.chdir(tmp_path)
    write_spikes(tmp_path / "clip.dat", SPIKES[0])
    recording = ["--data", "Recording", "--data.path", "clip.dat", "--data.height", "8", "--data.width", "10"]
    recording += ["--data.white", "0.4", "--trainer.accelerator", "cpu"]
    if how == "argument":
        args = ["predict", "--model.weights", file.name]
        command = [sys.executable, "-m", "lightning_modules", *args, *recording, "-o", "out"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        said = done.stderr
    else:
        (tmp_path / "own.yaml").write_text(yaml.safe_dump({"model": {"weights": file.name}}))
        args = ["predict", "-c", "own.yaml"]
        main([*args, *recording, "-o", "out"])
        said = capfd.readouterr().err
    assert "ZeroFlow" not in said
    expected = network()(SPIKES)[0].clamp(0, 1)
    assert (read_picture(tmp_path / "out" / "frame_000020.png") - expected).abs().max() < 0.51 / 255
    main([*args, "--model.network.motion", "ZeroFlow", *recording, "-o", "still"])
    still = network()(SPIKES, torch.zeros(1, 2, 2, 8, 10))[0].clamp(0, 1)
    assert (read_picture(tmp_path / "still" / "frame_000020.png") - still).abs().max() < 0.51 / 255
    capfd.readouterr()
    with pytest.raises(SystemExit) as exit:
        main([*args, "--model.network.width", "8", *recording, "-o", "no"])
    assert exit.value.code == 2
    assert capfd.readouterr().err.endswith("was trained with width=4; this run asks for width=8\n")


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        ([], Spike2Flow),
        (["-c", "{configs}/motion/zero.yaml"], ZeroFlow),
        (["-c{configs}/motion/zero.yaml"], ZeroFlow),
        (["--model.network.motion", "ZeroFlow"], ZeroFlow),
        (["--model.network.motion", "ZeroFlow", "-c", "{configs}/x2.yaml"], ZeroFlow),
        (["--model.network.motion.iterations", "1"], Spike2Flow),
    ],
)
def test_motion_is_that_of_the_weights_unless_another_is_named(named, expected, tmp_path, configs, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lightning"])
    trained = checkpoint(tmp_path / "moving.ckpt", SuperResolution(network(motion=Spike2Flow(**FLOW_TINY))))
    words = [word.format(configs=configs) for word in named]
    built = run(["test", "-c", str(configs / "x2.yaml"), *words, "--model.weights", str(trained)], Rehearsal)
    motion = built.model.network.motion
    assert type(motion) is expected
    if expected is Spike2Flow:
        assert motion.iterations == (1 if named else 3)


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        ([], 0.3),
        (["-c", "{configs}/data/films.yaml"], 0.3),
        (["-c", "{configs}/data/paper.yaml"], 0.6),
        (["-c", "{configs}/data/paper.yaml", "--model.network.alpha", "0.5"], 0.5),
        (["--model.network.alpha", "0.4"], 0.4),
    ],
)
def test_gain_is_that_of_the_weights_unless_another_is_named(named, expected, tmp_path, configs, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lightning"])
    film = tmp_path / "film"
    film.mkdir()
    for number in range(13):
        write_picture(film / f"{number:03d}.png", torch.zeros(3, 16, 16))
    words = [word.format(configs=configs) for word in [*named, "--data.root", str(tmp_path)]]
    trained = checkpoint(tmp_path / "bright.ckpt", SuperResolution(network(alpha=0.3)))
    built = run(["test", "-c", str(configs / "x2.yaml"), *words, "--model.weights", str(trained)], Rehearsal)
    assert built.model.network.settings["alpha"] == built.datamodule.options["alpha"] == expected
    own = CSCSR.from_pretrained(trained)
    torch.testing.assert_close(built.model.network(SPIKES), own(SPIKES) * (0.3 / expected))


@pytest.mark.slow
def test_fit_goes_on_from_weights_and_data_follow_them(file, tmp_path):
    x4 = Path(__file__).parents[3] / "configs" / "x4.yaml"
    (tmp_path / "tiny.yaml").write_text(
        "data: {init_args: {patch: 8, val_patch: 8, train_clips: 4, val_clips: 1, workers: 0}}\n"
        "trainer: {max_steps: 1, check_val_every_n_epoch: 1}\n"
    )
    args = ["-c", x4, "-c", tmp_path / "tiny.yaml", "--model.weights", file, "--model.optimizer.lr", "1e-12"]
    main(["fit", *map(str, args), "-o", str(tmp_path / "run")])
    after = CSCSR.from_pretrained(tmp_path / "run" / "checkpoints" / "last.ckpt")
    assert after.scale == 2
    torch.testing.assert_close(after(SPIKES), network()(SPIKES))
