"""Old names go on working: modules, what modules held, commands, and classes in configurations."""

import importlib
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lightning_modules.cli.arguments import arguments_preset
from lightning_modules.cli.command import run
from lightning_modules.cli.rehearsal import Rehearsal
from lightning_modules.inference.presets import Preset
from lightning_modules.networks import ClassicalDecoder
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import Film, SceneProfile, SensorNoise
from spikekit._renamed import RENAMED
from spikekit.cli.command import _parser as command_parser
from spikekit.scenes.adaptive_sampling import profile_interval

ROOT = Path(__file__).parents[1]

#: of modules that are packages now: what they held, and where it is
MOVED = {
    "lightning_modules.cli": {
        "lightning_modules.__main__": ["main"],
        "lightning_modules.cli.errors": ["InputError"],
        "lightning_modules.cli.command": ["CHOICES", "Command", "Parser", "check_folder", "run"],
    },
    "spikekit.cli": {"spikekit.cli.info": ["CLOCK_HZ"], "spikekit.cli.decode": ["TFI_REACH", "TFP_WINDOW"]},
    "spikekit.decoders": {"spikekit.decoders.dense": ["cast_light", "check_window", "interval_dtype"]},
}


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_an_old_name_is_the_module_of_the_new_one(old, new):
    assert importlib.import_module(old) is importlib.import_module(new)
    assert sys.modules[old] is sys.modules[new]


def test_no_new_name_is_an_old_one():
    assert not set(RENAMED) & set(RENAMED.values())
    for old in RENAMED:
        path = ROOT.joinpath(*old.split("."))
        assert not path.with_suffix(".py").exists()
        assert not path.is_dir()


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [(old, new, name) for old, homes in MOVED.items() for new, names in homes.items() for name in names],
)
def test_what_a_module_held_is_found_where_it_was(old, new, name):
    assert getattr(importlib.import_module(old), name) is getattr(importlib.import_module(new), name)


@pytest.mark.parametrize("package", MOVED)
def test_other_names_are_missing_as_ever(package):
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        _ = importlib.import_module(package).nothing


def python(*words):
    return subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_old_imports_work_before_anything_else_is_imported():
    lines = [
        "from lightning_modules.cli import main, InputError",
        "from lightning_modules.module import SuperResolution",
        "from lightning_modules.speed import choose",
        "import lightning_modules.look, spikekit.encoding, spikekit.demosaic",
        "from spikekit import demosaic",
        "assert callable(demosaic) and SuperResolution.__name__ == 'SuperResolution'",
    ]
    result = python("-c", "\n".join(lines))
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("spikekit.savings", "spikekit.bench.adaptive_sampling"),
        ("lightning_modules.savings", "lightning_modules.trade.adaptive"),
    ],
)
def test_old_commands_run(old, new, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")  # not as wide as the terminal, for either
    said = python("-m", old, "--help")
    assert said.returncode == 0, said.stderr
    monkeypatch.setattr(sys, "argv", [new, "--help"])
    monkeypatch.delitem(sys.modules, new, raising=False)
    with pytest.raises(SystemExit, match=r"^0$"):
        runpy.run_module(new, run_name="__main__")
    assert said.stdout == capsys.readouterr().out
    assert "usage:" in said.stdout


def test_classes_of_old_configurations(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lightning"])
    (tmp_path / "old.yaml").write_text(
        "model:\n  class_path: lightning_modules.module.SuperResolution\n"
        "data:\n  class_path: lightning_modules.data.StillScenes\n"
    )
    command = run(["test", "-c", str(ROOT / "configs" / "x4.yaml"), "-c", str(tmp_path / "old.yaml")], Rehearsal)
    assert type(command.model).__module__ == "lightning_modules.tasks.super_resolution"


def test_old_names_of_the_tolerance_that_is_a_share_of_spikes():
    profile = SceneProfile((8, 8), 20, (0.1, 0.2, 0.3), 0.0, displacement=0.1, blending=1.8)
    assert profile.plan(tolerance=0.2) == profile.plan(spike_tolerance=0.2) != profile.plan()
    noise = SensorNoise(photons=1e6, hot=0.01)
    assert noise.required(0.2, 41, tolerance=0.005) == noise.required(0.2, 41, spike_tolerance=0.005) != noise
    frames = [torch.rand(3, 16, 16), torch.rand(3, 16, 16)]
    assert Film(frames, scale=4, tolerance=0.01).spike_tolerance == 0.01
    still = profile_interval(frames[0], frames[0] + 1e-4, scale=4, tolerance=1.0)
    assert still.static == 1.0 != profile_interval(frames[0], frames[1], scale=4, spike_tolerance=1e-9).static
    for call in (profile.plan, lambda **both: Film(frames, scale=4, **both)):
        with pytest.raises(TypeError, match="tolerance: expected spike_tolerance alone, of which it is the old name"):
            call(tolerance=0.1, spike_tolerance=0.1)
    for option in ("--tolerance", "--spike-tolerance"):
        words = ["simulate", "film", "-o", "out.dat", "--scale", "4", option, "0.2"]
        asked = command_parser("simulate").parse_args(words)
        assert asked.tolerance == 0.2


def test_old_names_of_the_tolerance_in_decibels(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lightning"])
    configs = ["test", "-c", str(ROOT / "configs" / "x4.yaml")]
    for typed in ("--model.tolerance=0.25", "--model.psnr_tolerance=0.25"):
        assert run([*configs, typed], Rehearsal).model.psnr_tolerance == 0.25
        assert arguments_preset([typed]) == Preset(psnr_tolerance=0.25)
    network = ClassicalDecoder()
    assert SuperResolution(network, tolerance=0.5).psnr_tolerance == 0.5
    with pytest.raises(ValueError, match="tolerance: expected psnr_tolerance alone, of which it is the old name"):
        SuperResolution(network, psnr_tolerance=0.5, tolerance=0.1)
