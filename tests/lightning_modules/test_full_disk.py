"""Files that lightning writes, on a full disk: the error names the file, and the previous file stays intact."""

import warnings

import pytest
import torch
import yaml

from lightning_modules.__main__ import main
from lightning_modules.data.cache import ClipCache
from lightning_modules.storage.pretrained import Weights, write_weights
from lightning_modules.sweep.trials import Trial
from lightning_modules.tasks.checkpoint_io import Checkpoints
from spikekit import write_spikes

TRIAL = {
    "model": {"class_path": "SuperResolution", "init_args": {"network": {"init_args": {"width": 4}}}},
    "trainer": {"max_steps": 6},
}


@pytest.mark.parametrize(
    ("name", "write"),
    [
        (
            "a.ckpt",
            lambda path: Checkpoints(path.parent).save_checkpoint({"state_dict": {"a": torch.rand(9999)}}, path),
        ),
        ("a.safetensors", lambda path: write_weights(Weights(path, {}, {}, {"a": torch.rand(9999)}), path)),
    ],
)
def test_existing_file_stays_intact(name, write, stays_whole):
    stays_whole(name, write)


def test_incomplete_trial_can_be_written_again(full_disk, tmp_path):
    for room, config, left in ((0, TRIAL, []), (20, {"a": 1}, ["trial.yaml"])):
        trial = Trial(("a",), None, tmp_path / "trial", config, {"steps": 10**100})
        with full_disk(room), pytest.raises(OSError, match="too large"):
            trial.write()
        assert [path.name for path in trial.folder.iterdir()] == left
    Trial(("a",), None, tmp_path / "trial", TRIAL, {"steps": 6}).write()
    assert yaml.safe_load((tmp_path / "trial" / "trial.yaml").read_text()) == TRIAL


def test_predicted_picture_is_complete_or_absent(full_disk, tmp_path):
    write_spikes(tmp_path / "clip.npz", torch.rand(41, 24, 32, generator=torch.Generator().manual_seed(0)) < 0.3)
    words = ["predict", str(tmp_path / "clip.npz"), "--weights", "cscsr_tiny_x4", "-o", str(tmp_path / "out")]
    with full_disk(6000), pytest.raises(SystemExit, match=r"frame_000020.png: File too large"):
        main(words)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".predict.lock"]
    main(words)
    assert (tmp_path / "out" / "frame_000020.png").stat().st_size > 6000


def test_cache_is_skipped_on_a_full_disk(full_disk, tmp_path):
    cache = ClipCache(tmp_path)
    with full_disk(2000), warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        clip = {"spikes": torch.zeros(9, 99, 99), "rgb": torch.rand(3, 99, 99)}
        assert cache.packed("ab" * 32, lambda: clip)["rgb"].shape == (3, 99, 99)
    assert "cannot be written" in str(said[0].message)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
