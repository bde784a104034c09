"""The ``lightning`` command."""

import csv
import re
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import torch
import yaml

import spikekit
from lightning_modules import list_models
from lightning_modules.__main__ import main
from lightning_modules.cli.command import Rehearsal
from lightning_modules.cli.command import run as run_command
from lightning_modules.cli.errors import InputError
from lightning_modules.storage.checkpoint import read_checkpoint
from spikekit import read_picture, write_spikes

TINY = """
model:
  network:
    init_args: {width: 4, representation_width: 4, features: 1, stages: 1, blocks: 1, end_blocks: 1}
data:
  init_args: {patch: 8, val_patch: 12, train_clips: 8, val_clips: 3, batch_size: 2, workers: 0}
trainer:
  max_steps: 6
  check_val_every_n_epoch: 1
  log_every_n_steps: 2
  enable_progress_bar: false
"""
X4 = Path(__file__).parents[3] / "configs" / "x4.yaml"


@pytest.fixture(scope="module")
def overlay(tmp_path_factory):
    path = tmp_path_factory.mktemp("overlay") / "tiny.yaml"
    path.write_text(TINY)
    return path


@pytest.fixture(scope="module")
def trained(overlay, tmp_path_factory):
    output = tmp_path_factory.mktemp("run")
    main(["fit", "-c", str(X4), "-c", str(overlay), "-o", str(output)])
    return output


class Fit(Rehearsal):
    """All of ``lightning fit`` but the training."""

    verb = "fit"


def weights(output, name="last"):
    return torch.load(output / "checkpoints" / f"{name}.ckpt", weights_only=True)


@pytest.mark.slow
def test_fit_writes_checkpoints_and_pictures(trained):
    assert weights(trained)["global_step"] == 6
    assert weights(trained, "best")["network"]["scale"] == 4
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(trained)).Reload()
    assert {"train/loss", "val/psnr", "val/ssim"} <= set(events.Tags()["scalars"])
    assert events.Tags()["images"] == ["val/tfi, result, truth"]
    config = yaml.safe_load((trained / "config.yaml").read_text())
    assert config["model"]["init_args"]["network"]["init_args"]["width"] == 4


def _files(folder, pattern):
    """The files of a name; one that is written anew is another."""
    found = set()
    for path in folder.glob(pattern):
        with suppress(FileNotFoundError):
            found.add((path, path.stat().st_ino, path.stat().st_mtime_ns))
    return found


@pytest.mark.slow
def test_killed_training_resumes(trained, overlay, configs, tmp_path, forked):
    """Its files are complete, and the weights equal those of an uninterrupted training."""
    folder = tmp_path / "checkpoints"
    args = ["fit", "-c", configs / "x4.yaml", "-c", overlay, "-o", tmp_path]
    for moment, pattern in ((0.01, "*.ckpt"), (0.0, ".*.part")):
        again = ["--ckpt_path", "last"] if any(folder.glob("*.ckpt")) else ["--data.workers", "1"]
        before, process = _files(folder, pattern), forked([*args, *again])
        while process.is_alive() and not _files(folder, pattern) - before:
            time.sleep(0.002)
        time.sleep(moment)
        process.kill()
        process.join()
        for path in folder.glob("*.ckpt"):
            read_checkpoint(path)
    assert any(folder.glob("*.ckpt"))
    main([*map(str, args), "--ckpt_path", "last"])
    resumed, unbroken = weights(tmp_path), weights(trained)
    assert resumed["global_step"] == unbroken["global_step"] == 6
    for name, value in unbroken["state_dict"].items():
        assert resumed["state_dict"][name].equal(value), name
    assert not list(folder.glob(".*"))


@pytest.mark.slow
def test_test_prints_and_writes_a_table(trained, overlay, configs, capsys):
    args = ["test", "-c", configs / "x4.yaml", "-c", overlay, "-o", trained, "--ckpt_path", "best"]
    main([*map(str, args)])
    printed = capsys.readouterr().out
    methods = ["TFI", "TFP", "CSCSR", "CSCSR, true flow"]
    assert all(f"\n| {method} " in printed for method in methods)
    rows = list(csv.DictReader((trained / "test.csv").open()))
    assert [row["clip"] for row in rows] == ["0", "1", "2", "mean"] * 4
    for method in methods:
        *clips, mean = [float(row["psnr"]) for row in rows if row["method"] == method]
        assert mean == pytest.approx(sum(clips) / 3, abs=1e-4)
        shown = re.search(rf"\n\| {method} +\| (\d+\.\d\d) ", printed)
        assert float(shown[1]) == pytest.approx(mean, abs=0.0051)  # the file has four decimals
    assert read_picture(trained / "test.png").shape == (3, 3 * 48 + 2 * 4, 5 * 48 + 4 * 4)


def test_short_help_names_existing_options(capsys):
    main(["fit", "--help"])
    short, known = capsys.readouterr().out, ""
    assert len(short.splitlines()) < 30
    for more in ("--help=all", "--model.help=SuperResolution", "--data.help=StillScenes"):
        with pytest.raises(SystemExit):
            main(["fit", more])
        known += capsys.readouterr().out
    named = re.findall(r"^  (-[\w.-]+)", short, re.MULTILINE)
    assert "--model.weights" in named
    assert [option for option in named if option not in known] == []


def test_integer_limits_are_numbers_of_batches(configs, overlay, tmp_path):
    words = ["fit", "-c", str(configs / "x4.yaml"), "-c", str(overlay), "-o", str(tmp_path)]
    words += ["--trainer.limit_val_batches", "1", "--trainer.limit_train_batches", "1.0", "--trainer.logger", "false"]
    trainer = run_command(words, Fit).trainer
    assert repr((trainer.limit_val_batches, trainer.limit_train_batches)) == "(1, 1.0)"


def test_verbs_that_need_no_trainer_do_not_import_lightning(tmp_path):
    write_spikes(tmp_path / "clip.npz", torch.rand(41, 8, 10) < 0.3)
    code = f"""
import gc, sys, lightning_modules
assert "CSCSR" in dir(lightning_modules) and "torch" not in sys.modules
from lightning_modules.__main__ import main
for words in (
    ["--version"], ["--help"], ["fit", "--help"], ["models"],
    ["predict", "{tmp_path}/clip.npz", "--speed", "fastest", "--calibration", "none", "-o", "{tmp_path}/out"],
    ["export", "cscsr_tiny_x4", "-o", "{tmp_path}/tiny.safetensors"],
):
    main(words)
assert gc.isenabled() and gc.get_freeze_count() > 100_000  # imports are not searched for garbage
import lightning_modules.adaptation.cli
assert "pytorch_lightning" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"lightning of spikekit {spikekit.__version__}\n")


def test_models_lists_the_weights_of_the_package(capsys):
    main(["models"])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 120
    _, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|"))
    assert [row[0] for row in rows] == [weights.name for weights in list_models()]
    assert ["cscsr_tiny_x4", "x4", "tiny", "41", "", "300,963", "0.36", "28.19", "23.51"] in [row[:-1] for row in rows]


@pytest.mark.slow
def test_only_fit_writes_config_yaml(trained, overlay, configs):
    before = (trained / "config.yaml").read_text()
    args = ["-c", configs / "x4.yaml", "-c", overlay, "-o", trained, "--ckpt_path", "best", "--data.val_clips", 1]
    for verb in ("validate", "test"):
        main([verb, *map(str, args)])
        assert (trained / "config.yaml").read_text() == before


@pytest.fixture(scope="module")
def begun(overlay, tmp_path_factory):
    """What a checkpoint holds before the first step."""
    words = ["fit", "-c", str(X4), "-c", str(overlay), "-o", str(tmp_path_factory.mktemp("begun"))]
    run = run_command(words, Fit)
    model, parts = run.model, run.model.configure_optimizers()
    content = {"state_dict": model.state_dict(), "epoch": 0, "global_step": 0}
    content |= {"optimizer_states": [parts["optimizer"].state_dict()]}
    content |= {"lr_schedulers": [parts["lr_scheduler"]["scheduler"].state_dict()]}
    content |= {"loops": {"fit_loop": run.trainer.fit_loop.state_dict()}}
    model.on_save_checkpoint(content)
    return content


@pytest.fixture(name="checkpoint")
def _checkpoint(begun, overlay, configs, tmp_path):
    """A command that goes on from a checkpoint, and the checkpoint."""
    (tmp_path / "checkpoints").mkdir()
    path = tmp_path / "checkpoints" / "last.ckpt"
    torch.save(begun, path)
    words = ["fit", "-c", str(configs / "x4.yaml"), "-c", str(overlay), "-o", str(tmp_path)]
    return [*words, "--ckpt_path", "last"], path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("--model.optimizer.lr=1e-3", "model.optimizer.lr: expected 0.0001, as .*last.ckpt was .* with, got 0.001"),
        ("--model.lr_scheduler.step_size=5", "model.lr_scheduler.step_size: expected 7500, .* got 5"),
        ("--model.optimizer=SGD", "model.optimizer.class_path: expected torch.optim.Adam, .* got torch.optim.SGD"),
        ("--model.network.width=6", "last.ckpt was trained with width=4; this run asks for width=6"),
    ],
)
def test_resume_rejects_settings_that_the_checkpoint_overrides(checkpoint, change, said):
    words, path = checkpoint
    with pytest.raises(InputError, match=said):
        run_command([*words, change], Fit)
    assert [file.name for file in path.parents[1].iterdir()] == ["checkpoints"]


@pytest.mark.parametrize("lacking", ["optimizer_states", "loops", "weight_decay"])
def test_resume_rejects_incomplete_checkpoints(checkpoint, lacking):
    words, path = checkpoint
    content = torch.load(path, weights_only=True)
    del (content if lacking in content else content["optimizer_states"][0]["param_groups"][0])[lacking]
    torch.save(content, path)
    with pytest.raises(InputError, match=rf"last.ckpt: training cannot resume from this checkpoint: .*{lacking}"):
        run_command(words, Fit)


def test_resume_allows_more_steps_other_data_and_older_checkpoints(checkpoint):
    words, path = checkpoint
    run_command([*words, "--trainer.max_steps=9", "--data.motion=1"], Fit)
    content = torch.load(path, weights_only=True)
    del content["recipe"]
    torch.save(content, path)
    run_command([*words, "--model.optimizer.lr=1e-3"], Fit)


@pytest.mark.parametrize("scale", [2, 3, 4])
def test_defaults_are_those_of_the_paper(scale, configs, capsys):
    with pytest.raises(SystemExit):
        main(["fit", "-c", str(configs / f"x{scale}.yaml"), "--print_config"])
    config = yaml.safe_load(capsys.readouterr().out)
    model, data = config["model"]["init_args"], config["data"]["init_args"]
    network, optimizer, schedule = model["network"], model["optimizer"], model["lr_scheduler"]
    for part, expected in (
        (network["init_args"], {"scale": scale, "frames": 41, "window": 11, "pattern": "RGGB", "alpha": 0.4}),
        (data, {"patch": 96, "batch_size": 4, "pattern": "RGGB"}),
        (optimizer, {"class_path": "torch.optim.Adam"}),
        (optimizer["init_args"], {"lr": 1e-4}),
        (schedule["init_args"], {"step_size": 7500, "gamma": 0.8}),
    ):
        assert {name: part[name] for name in expected} == expected
    assert config["output"] == f"runs/x{scale}"
