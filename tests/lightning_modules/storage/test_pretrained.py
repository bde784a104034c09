"""Files of weights, in Python and on the command line."""

import json
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from lightning_modules.__main__ import main
from lightning_modules.cli.command import Rehearsal, run
from lightning_modules.motion import ClassicalFlow, Spike2Flow, ZeroFlow
from lightning_modules.networks import CSCSR, ClassicalDecoder
from lightning_modules.storage.pretrained import load_weights, read_weights, write_weights
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import write_picture

TINY = {"scale": 2, "width": 4, "representation_width": 4, "features": 1, "stages": 1, "end_blocks": 1, "skip": True}
FLOW_TINY = {"window": 5, "widths": (4,), "features": 4, "hidden": 4, "correlation": (4, 4), "motion": 4, "head": 4}
SPIKES = torch.rand(1, 41, 8, 10, generator=torch.Generator().manual_seed(0)) < 0.3


def network(**changes):
    torch.manual_seed(0)
    made = CSCSR(**{**TINY, **changes})
    torch.nn.init.normal_(made.reconstruction.rgb.weight, std=0.1)  # the skip initialises it with zeros
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
def test_weights_work_with_any_motion_fusion(fusion, file):
    other = network(motion_fusion=fusion, motion=ZeroFlow())
    load_weights(other, read_weights(file))
    assert other.config.motion_fusion == fusion
    torch.testing.assert_close(other(SPIKES), network(motion=ZeroFlow())(SPIKES))


def test_unsuitable_weights_are_rejected(file, tmp_path):
    with pytest.raises(ValueError, match="expected weights of ClassicalDecoder, got those of CSCSR"):
        ClassicalDecoder.from_pretrained(file)
    with pytest.raises(ValueError, match=r"trained with scale=2, width=4; this run asks for scale=4, width=8"):
        SuperResolution(network(scale=4, width=8), weights=str(file))
    with pytest.raises(FileNotFoundError, match=r"x9-z: expected a file of weights or a name in the package"):
        CSCSR.from_pretrained("x9-z")
    plain = tmp_path / "plain.safetensors"
    save_file(load_file(file), plain)
    with pytest.raises(ValueError, match=r"plain.safetensors: expected metadata of the network"):
        CSCSR.from_pretrained(plain)
    tensors, said = load_file(file), {"network": json.dumps({"class": "CSCSR", **network().settings}), "motion": "{}"}
    tensors["reconstruction.rgb.weight"] = tensors["reconstruction.rgb.weight"][:1].clone()
    save_file(tensors, plain, said)
    with pytest.raises(ValueError, match=r"plain.safetensors: weights do not fit .*rgb.weight"):
        CSCSR.from_pretrained(plain)
    with pytest.raises(ValueError, match=r"ends in .safetensors"):
        write_weights(read_weights(file), tmp_path / "file.bin")


def test_weights_that_share_memory_can_be_exported(tmp_path):
    shared = torch.zeros(3)
    found = read_weights("cscsr_tiny_x4")
    write_weights(replace(found, tensors={"a": shared, "b": shared}), tmp_path / "shared.safetensors")
    assert set(load_file(tmp_path / "shared.safetensors")) == {"a", "b"}


def test_module_can_be_pickled():
    module = SuperResolution(CSCSR.from_pretrained("cscsr_tiny_x4"))
    spikes = torch.ones(1, 41, 8, 8)
    assert torch.equal(pickle.loads(pickle.dumps(module))(spikes), module(spikes))


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        ([], Spike2Flow),
        (["-c{still}"], ZeroFlow),
        (["--model.network.motion", "ZeroFlow"], ZeroFlow),
        (["--model.network.motion.iterations", "1"], Spike2Flow),
    ],
)
def test_motion_estimator_comes_from_the_weights_by_default(named, expected, tmp_path, configs, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lightning"])
    trained = checkpoint(tmp_path / "moving.ckpt", SuperResolution(network(motion=Spike2Flow(**FLOW_TINY))))
    (tmp_path / "still.yaml").write_text("model: {network: {init_args: {motion: {class_path: ZeroFlow}}}}")
    words = [word.format(configs=configs, still=tmp_path / "still.yaml") for word in named]
    built = run(["test", "-c", str(configs / "x2.yaml"), *words, "--model.weights", str(trained)], Rehearsal)
    motion = built.model.network.motion
    assert type(motion) is expected
    if expected is Spike2Flow:
        assert motion.iterations == (1 if named else 3)


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        (["-c", "{configs}/data/films.yaml"], 0.3),
        (["-c", "{configs}/data/paper.yaml"], 0.6),
        (["-c", "{configs}/data/paper.yaml", "--model.network.alpha", "0.5"], 0.5),
    ],
)
def test_gain_comes_from_the_weights_by_default(named, expected, tmp_path, configs, monkeypatch):
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
def test_fit_starts_from_weights_and_data_follow_their_settings(file, tmp_path):
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


def test_files_of_the_same_weights_are_identical(tmp_path):
    weights, written = read_weights("cscsr_tiny_x4"), set()
    for _ in range(8):
        write_weights(weights, tmp_path / "weights.safetensors")
        written.add((tmp_path / "weights.safetensors").read_bytes())
    assert len(written) == 1
