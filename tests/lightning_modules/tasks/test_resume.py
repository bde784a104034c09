"""Training that is stopped and resumed."""

import os
import re
import signal
import sys

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lightning_modules.__main__ import main

TINY = """
model: {network: {init_args: {width: 4, representation_width: 4, features: 1, stages: 1, blocks: 1, end_blocks: 1}}}
data: {init_args: {patch: 8, val_patch: 12, train_clips: 8, val_clips: 2, batch_size: 2, workers: 0}}
trainer: {check_val_every_n_epoch: 2, log_every_n_steps: 1, max_steps: 10, accelerator: cpu}
"""
STOPS = """
import os, signal
from pytorch_lightning import Callback
class Stop(Callback):
    def __init__(self, step: int, where: str = "step", signal: int = signal.SIGTERM):
        self.step, self.where, self.signal = step, where, signal
    def _stop(self, trainer, where):
        if trainer.global_step == self.step and self.where == where and not trainer.sanity_checking:
            os.kill(os.getpid(), self.signal)
    def on_train_batch_end(self, trainer, *_):
        self._stop(trainer, "step")
    def on_validation_batch_end(self, trainer, *_):
        self._stop(trainer, "validation")
"""


@pytest.fixture(name="fit")
def _fit(tmp_path, monkeypatch, configs):
    (tmp_path / "tiny.yaml").write_text(TINY)
    (tmp_path / "stops.py").write_text(STOPS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lightning"])
    monkeypatch.chdir(tmp_path)

    def run(output, *words):
        shown = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]
        main(["fit", "-c", str(configs / "x4.yaml"), "-c", "tiny.yaml", "-o", str(output), *shown, *words])
        return torch.load(tmp_path / output / "checkpoints" / "last.ckpt", weights_only=True)

    return run


def stop(step, where="step", number=signal.SIGTERM, times=1):
    arguments = f'{{"step": {step}, "where": "{where}", "signal": {number:d}}}'
    each = f'{{"class_path": "stops.Stop", "init_args": {arguments}}}'
    return [f"--trainer.callbacks=[{', '.join([each] * times)}]"]


def logged(folder):
    events = EventAccumulator(str(folder)).Reload()
    return {step.step: step.value for step in events.Scalars("train/loss")}


@pytest.fixture(name="unbroken")
def _unbroken(fit, tmp_path, _once={}):  # noqa: B006
    if not _once:
        _once.update(weights=fit("unbroken")["state_dict"], losses=logged("unbroken"), best=best("unbroken"))
    return _once


def best(folder):
    return torch.load(f"{folder}/checkpoints/best.ckpt", weights_only=True)["global_step"]


def same(weights, others):
    return all(value.equal(others[name]) for name, value in weights.items())


@pytest.mark.parametrize(
    ("step", "where", "number", "requeued"),
    [(6, "step", signal.SIGTERM, True), (8, "validation", signal.SIGTERM, False), (7, "step", signal.SIGINT, False)],
)
def test_training_resumes_exactly_when_stopped(
    fit, unbroken, tmp_path, step, where, number, requeued, capfd, monkeypatch
):
    """By ``--ckpt_path last``, or where Slurm starts a job again, without being asked."""
    with pytest.raises(SystemExit) as ended:
        fit("broken", *stop(step, where, number))
    assert ended.value.code == 128 + number
    by = "Ctrl-C" if number == signal.SIGINT else "SIGTERM"
    assert f"stopped by {by}; --ckpt_path last resumes" in capfd.readouterr().err
    last = tmp_path / "broken" / "checkpoints" / "last.ckpt"
    assert torch.load(last, weights_only=True)["global_step"] == step
    if requeued:
        monkeypatch.setenv("SLURM_JOB_ID", "1")
        os.rename(last, tmp_path / "broken" / "hpc_ckpt_1.ckpt")
    resumed = fit("broken", *(() if requeued else ("--ckpt_path", "last")))
    assert same(unbroken["weights"], resumed["state_dict"])
    assert logged("broken") == unbroken["losses"]  # at the same steps, too
    assert best("broken") == unbroken["best"]


def test_a_second_ctrl_c_stops_at_once_with_one_line_and_status_130(fit, tmp_path, capfd):
    with pytest.raises(SystemExit) as ended:
        fit("broken", *stop(2, number=signal.SIGINT, times=2))
    assert ended.value.code == 130
    assert len(re.findall("lightning: .*", capfd.readouterr().err)) == 1
    assert not (tmp_path / "broken" / "checkpoints" / "last.ckpt").exists()


def test_plateau_schedule_monitors_the_best_metric(fit):
    words = ["--model.lr_scheduler=torch.optim.lr_scheduler.ReduceLROnPlateau", "--model.lr_scheduler.mode=max"]
    words += ["--model.lr_scheduler.patience=0", "--model.lr_scheduler.threshold=1000"]
    checkpoint = fit("run", "--trainer.check_val_every_n_epoch=1", "--trainer.max_steps=12", *words)
    rate = checkpoint["optimizer_states"][0]["param_groups"][0]["lr"]
    assert rate == pytest.approx(1e-5)  # after the second of two validations


@pytest.mark.slow
def test_spawned_processes(tmp_path, configs, monkeypatch):
    (tmp_path / "tiny.yaml").write_text(TINY)
    monkeypatch.chdir(tmp_path)
    words = ["fit", "-c", str(configs / "x4.yaml"), "-c", "tiny.yaml", "--trainer.max_steps=2", "--trainer.devices=1"]
    main([*words, "--trainer.strategy=ddp_spawn", "-o", "run"])
    assert torch.load(tmp_path / "run/checkpoints/last.ckpt", weights_only=True)["global_step"] == 2


def test_home_in_the_output_path_is_expanded(fit, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "there.yaml").write_text("output: ~/run")
    with pytest.raises(FileNotFoundError):  # by this test, which does not know of ~
        fit("~/run", "--trainer.max_steps=1")
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()
    with pytest.raises(SystemExit, match="holds a run already"):
        fit("~/run", "-c", "there.yaml")
