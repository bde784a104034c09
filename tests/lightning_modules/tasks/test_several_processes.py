"""``lightning fit`` with several processes."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

from lightning_modules.__main__ import main
from lightning_modules.storage.checkpoint import read_checkpoint

CONFIGS = Path(__file__).parents[3] / "configs"
TINY = """
model: {network: {init_args: {width: 4, representation_width: 4, features: 1, stages: 1, blocks: 1, end_blocks: 1}}}
data: {init_args: {patch: 12, val_patch: 16, train_clips: 9, val_clips: 2, workers: 0}}
trainer: {accelerator: cpu, enable_progress_bar: false}
"""


def trained(output):
    checkpoint = read_checkpoint(output / "checkpoints" / "last.ckpt")
    scores = [state["best_model_score"] for state in checkpoint["callbacks"].values() if state.get("best_model_score")]
    return checkpoint["state_dict"], checkpoint["global_step"], max(scores).item()


@pytest.mark.slow
def test_two_processes_equal_one_with_twice_the_batch(tmp_path, monkeypatch, forked):
    (tmp_path / "tiny.yaml").write_text(TINY)
    words = ["fit", "-c", CONFIGS / "x2.yaml", "-c", CONFIGS / "quick.yaml", "-c", tmp_path / "tiny.yaml"]
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    two = [*words, "-o", tmp_path / "two", "--data.batch_size", 2, "--trainer.max_steps", 4]
    two = [*map(str, [*two, "--trainer.devices", 2, "--trainer.strategy", "ddp"])]
    with monkeypatch.context() as patch:  # Lightning starts the second process as the first one was started
        patch.setattr(sys.modules["__main__"], "__spec__", importlib.util.find_spec("lightning_modules.__main__"))
        patch.setattr(sys, "argv", ["lightning", *two])
        first = forked(two)
    first.join()
    assert first.exitcode == 0
    main([*map(str, [*words, "-o", tmp_path / "one", "--trainer.max_steps", 4, "--data.batch_size", 4])])
    (ours, step, score), (theirs, theirs_step, theirs_score) = trained(tmp_path / "two"), trained(tmp_path / "one")
    assert step == theirs_step == 4
    assert score == pytest.approx(theirs_score, abs=1e-3)
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], rtol=0, atol=1e-5)
    assert (tmp_path / "two" / "config.yaml").is_file()
