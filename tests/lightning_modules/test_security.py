"""Untrusted files: weights and checkpoints cannot run or import code, and their contents are checked."""

import json
import os
import sys
import zipfile

import pytest
import torch
from safetensors.torch import save_file

from lightning_modules import motion, networks
from lightning_modules.__main__ import main
from lightning_modules.cli.arguments import with_network_of_weights
from lightning_modules.cli.errors import as_one_line
from lightning_modules.motion import ESTIMATORS
from lightning_modules.networks import CSCSR, NETWORKS
from lightning_modules.storage.checkpoint import read_checkpoint
from lightning_modules.storage.pretrained import read_weights
from lightning_modules.storage.settings import check_plain, own_class
from lightning_modules.tasks.checkpoint_io import Checkpoints
from lightning_modules.tasks.super_resolution import SuperResolution

TINY = {"scale": 2, "width": 4, "representation_width": 4, "features": 1, "stages": 1, "end_blocks": 1}


@pytest.fixture(autouse=True)
def _argv(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lightning"])


@pytest.fixture(name="content", scope="module")
def _content():
    """A function that returns a new checkpoint, as tests modify it."""

    def make():
        torch.manual_seed(0)
        module = SuperResolution(CSCSR(**TINY))
        content = {"state_dict": module.state_dict(), "pytorch-lightning_version": "2.5.0", "global_step": 0}
        module.on_save_checkpoint(content)
        return content

    return make


@pytest.fixture(name="trap")
def _trap(tmp_path, monkeypatch):
    """A module that writes a trace file on import and on a call of its function; returns the path of the trace."""
    trace = tmp_path / "trace"
    (tmp_path / "evilmod.py").write_text(
        f"import pathlib\npathlib.Path({str(trace)!r}).touch()\n\n\ndef X(*args, **kwargs):\n    return None\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "evilmod", raising=False)
    return trace


@pytest.mark.parametrize(
    ("verb", "hyper"),
    [
        ("fit", {"optimizer": {"class_path": "evilmod.X"}, "_instantiator": "evilmod.X"}),
        ("test", {"network": {"class_path": "evilmod.X"}}),
        ("predict", {"_class_path": "evilmod.X"}),
    ],
)
def test_hyper_parameters_of_a_checkpoint_build_nothing(verb, hyper, content, trap, tmp_path):
    path, nowhere = str(tmp_path / "a.ckpt"), str(tmp_path / "nowhere")
    torch.save({**content(), "hyper_parameters": hyper}, path)
    # wrong at the end, so that nothing is computed: what a checkpoint says would have been built before
    wrong = [nowhere] if verb == "predict" else ["--data.root", nowhere]
    with pytest.raises(SystemExit):
        main([verb, "-c", "x2", "--ckpt_path", path, "-o", str(tmp_path / "o"), *wrong])
    assert not trap.exists()
    assert "hyper_parameters" not in Checkpoints(tmp_path).load_checkpoint(path)


def test_code_in_a_checkpoint_is_not_run_by_lightning(content, tmp_path, monkeypatch):
    class Harmful:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harmed"),)

    torch.save({**content(), "callbacks": Harmful()}, tmp_path / "a.ckpt")
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    with pytest.raises(ValueError, match=r"a.ckpt: not a checkpoint of lightning fit \(UnpicklingError") as refused:
        Checkpoints(tmp_path).load_checkpoint(tmp_path / "a.ckpt", weights_only=False)
    assert "weights_only" not in str(refused.value)  # what torch advises would run it
    assert not (tmp_path / "harmed").exists()


def write(path, settings, motion, tensors):
    """Write weights with these settings, as safetensors or as a checkpoint."""
    if path.suffix == ".safetensors":
        save_file(tensors, path, {"network": json.dumps(settings), "motion": json.dumps(motion)})
    else:
        tensors = {f"network.{name}": value for name, value in tensors.items()}
        torch.save({"network": settings, "motion": motion, "state_dict": tensors}, path)
    return path


SETTINGS = {"class": "CSCSR", **CSCSR(**TINY).settings}
ESTIMATOR = {"class": "Spike2Flow", "window": 5}


@pytest.mark.parametrize(
    ("settings", "motion"),
    [
        ({**SETTINGS, "motion": {"class_path": "evilmod.X"}}, {}),
        ({**SETTINGS, "class": "evilmod.X"}, {}),
        ({**SETTINGS, "class": ["CSCSR"]}, {}),
        ({**SETTINGS, "weights": "cscsr_tiny_x4"}, {}),
        ({**SETTINGS, "representation": "evilmod.X"}, {}),
        ({**SETTINGS, "width": True}, {}),
        ({**SETTINGS, "a\nb": 1}, {}),
        (SETTINGS, {"class": "evilmod.X"}),
        (SETTINGS, {"class": "CSCSR"}),
        (SETTINGS, {**ESTIMATOR, "weights": "spike2flow"}),
        (SETTINGS, {**ESTIMATOR, "widths": [4] * 1000}),
        (SETTINGS, {**ESTIMATOR, "radius": 10**6}),
        (SETTINGS, ["evilmod.X"]),
        ({}, {}),
    ],
)
def test_settings_can_only_name_known_classes_and_arguments(settings, motion, trap, tmp_path):
    for suffix in (".safetensors", ".ckpt"):
        path = write(tmp_path / f"odd{suffix}", settings, motion, CSCSR(**TINY).state_dict())
        with pytest.raises(ValueError, match=f"odd{suffix}: "):
            CSCSR.from_pretrained(path)
        with pytest.raises(ValueError, match=rf"^{path}: [^\n]{{1,600}}$"):
            with_network_of_weights(["test", "--model.weights", str(path)])
    assert not trap.exists()
    assert "evilmod" not in sys.modules


@pytest.mark.parametrize(
    "changes",
    [
        {"end_blocks": 10**30},
        {"end_blocks": 4000, "stages": 4000, "blocks": 4000},
        {"width": 4000},
        {"neighbors": 10**9},
        {"representation": "spikes", "window": 1, "stride": 1, "frames": 4095, "width": 4096},
    ],
)
def test_large_settings_are_rejected_before_memory_is_allocated(changes, tmp_path, monkeypatch):
    made = []
    real = torch.nn.init.orthogonal_
    monkeypatch.setattr(torch.nn.init, "orthogonal_", lambda *args, **kwargs: made.append(1) or real(*args, **kwargs))
    path = write(tmp_path / "large.safetensors", {**SETTINGS, **changes}, {}, {"a": torch.zeros(3)})
    with pytest.raises(ValueError, match=r"large.safetensors: ") as refused:
        CSCSR.from_pretrained(path)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400
    assert not made  # initial weights are what takes the time


def test_table_of_networks_is_complete():
    """A checkpoint of each network is read, with shapes compared without building it."""
    kinds = {**NETWORKS, **ESTIMATORS}
    assert set(networks.__all__) - {"NETWORKS", "CSCSRConfig", "Network"} == set(NETWORKS)
    assert set(motion.__all__) - {"ESTIMATORS", "MotionEstimator"} == set(ESTIMATORS)
    for name, kind in kinds.items():
        if hasattr(built := kind(), "settings"):
            assert own_class({"class": name, **built.settings}, "file", kinds)[1] == built.settings


@pytest.mark.parametrize(("suffix", "bad"), [(".safetensors", float("nan")), (".ckpt", -float("inf"))])
def test_weights_that_are_not_finite_are_rejected(bad, suffix, tmp_path):
    tensors = CSCSR(**TINY).state_dict()
    tensors["reconstruction.rgb.bias"][1] = bad
    path = write(tmp_path / f"bad{suffix}", SETTINGS, {}, tensors)
    with pytest.raises(ValueError, match=rf"bad{suffix}: .*reconstruction.rgb.bias: expected finite weights"):
        read_weights(path)


def test_diverged_training_keeps_its_last_good_checkpoint(content, tmp_path):
    path = tmp_path / "last.ckpt"
    Checkpoints(tmp_path).save_checkpoint(content(), path)
    before, bad = path.read_bytes(), content()
    next(iter(bad["state_dict"].values()))[0] = float("nan")
    with (
        pytest.raises(SystemExit, match=r"^lightning: .*last.ckpt: not written, as the training has diverged"),
        as_one_line(),
    ):
        Checkpoints(tmp_path).save_checkpoint(bad, path)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    "odd",
    [
        torch.zeros(1).expand(10**12),
        torch.zeros(3).to_sparse(),
        torch.zeros(3, dtype=torch.complex64),
        "text",
    ],
)
def test_tensors_beyond_the_data_of_the_file_are_rejected(odd, tmp_path):
    path = tmp_path / "odd.ckpt"
    torch.save({"network": SETTINGS, "state_dict": {"network.reconstruction.rgb.bias": odd}}, path)
    with pytest.raises(ValueError, match=r"odd.ckpt: not a checkpoint of lightning fit \(TypeError"):
        read_checkpoint(path)


@pytest.mark.parametrize("odd", [{"loops": "x"}, {"callbacks": 0.5}, {"optimizer_states": {}}, {"epoch": "1"}])
def test_parts_of_another_kind_are_rejected(odd, content, tmp_path):
    torch.save({**content(), **odd}, tmp_path / "odd.ckpt")
    with pytest.raises(ValueError, match=rf"odd.ckpt: .*{next(iter(odd))}: expected a "):
        read_checkpoint(tmp_path / "odd.ckpt")


def test_compressed_checkpoint_is_rejected(content, tmp_path):
    """A megabyte could expand to a gigabyte of memory."""
    torch.save(content(), tmp_path / "plain.ckpt")
    with zipfile.ZipFile(tmp_path / "plain.ckpt") as plain, zipfile.ZipFile(tmp_path / "a.ckpt", "w") as packed:
        for member in plain.infolist():
            packed.writestr(member.filename, plain.read(member), zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match=r"a.ckpt: .*compress"):
        read_checkpoint(tmp_path / "a.ckpt")


def test_only_plain_values_are_accepted():
    check_plain("a", {"b": [1, 2.5, "c", None, True, (1, 2)], "d": {"e": {}}})
    nested = []
    nested.append(nested)
    for odd in (nested, torch.ones(1), float("inf"), {"a": {3}}, 1j):
        with pytest.raises(ValueError, match=r"^a: expected plain values") as refused:
            check_plain("a", odd)
        assert "\n" not in str(refused.value)


def test_resumed_training_removes_only_checkpoints_of_its_own_run(content, tmp_path):
    """ModelCheckpoint removes the files that its restored state names."""
    own, saved, other, notes = (tmp_path / name for name in ("run/a.ckpt", "b.ckpt", "other.ckpt", "run/notes.txt"))
    checkpoints = Checkpoints(tmp_path / "run")
    checkpoints.save_checkpoint(content(), saved)
    own.parent.mkdir()
    for path in (own, other, notes):
        path.touch()
    for path in (own, saved, other, notes, tmp_path, own.parent / ".." / "other.ckpt", own.parent / "nothing.ckpt"):
        checkpoints.remove_checkpoint(str(path))
    assert [path.exists() for path in (own, saved, other, notes)] == [False, False, True, True]


@pytest.mark.parametrize("ending", [".ckpt", ".safetensors"])
def test_random_damage_gives_a_one_line_error_with_the_file_name(fuzz, content, tmp_path, ending):
    good = tmp_path / f"good{ending}"
    if ending == ".ckpt":
        torch.save(content(), good)
    else:
        write(good, SETTINGS, {}, CSCSR(**TINY).state_dict())
    assert fuzz(read_weights, lambda rng: fuzz.damage(good.read_bytes(), rng), f"bad{ending}", cases=60) > 20
