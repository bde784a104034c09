"""Every writer on a full disk: an error that names the file, what was there before, and nothing else."""

import resource
import warnings
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from lightning_modules.charts import chart
from lightning_modules.data.cache import ClipCache
from lightning_modules.pretrained import Weights, write_weights
from lightning_modules.sweep.state import write_json
from lightning_modules.tasks.checkpoint_io import Checkpoints
from spikekit import write_picture, write_spikes

SPIKES = (torch.rand(200, 64, 64) < 0.4).to(torch.uint8)


@contextmanager
def full(room):
    """No file grows beyond so many bytes; Python ignores the signal, so that writing fails as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def draw(path):
    with chart(path, 3, 2) as axes:
        axes.plot([0, 1])


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("chart.png", draw),
        ("a.png", lambda path: write_picture(path, torch.rand(3, 64, 64))),
        ("a.dat", lambda path: write_spikes(path, SPIKES)),
        ("a.npz", lambda path: write_spikes(path, SPIKES)),
        ("a.ckpt", lambda path: Checkpoints().save_checkpoint({"state_dict": {"a": torch.rand(9999)}}, path)),
        ("a.safetensors", lambda path: write_weights(Weights(path, {}, {}, {"a": torch.rand(9999)}), path)),
        ("a.json", lambda path: write_json(path, list(range(9999)))),
    ],
)
@pytest.mark.parametrize("room", [0, 2000])
def test_what_was_there_stays(name, write, room, tmp_path):
    (tmp_path / name).write_bytes(b"old")
    with full(room), pytest.raises((OSError, ValueError), match=name):
        write(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes() == b"old"
    write(tmp_path / name)
    assert (tmp_path / name).stat().st_size > 2000


def test_the_cache_goes_on_without(tmp_path):
    cache = ClipCache(tmp_path)
    with full(2000), warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        cache.store("ab" * 32, {"a": np.zeros(9999)})
    assert "cannot be written" in str(said[0].message)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert cache.load("ab" * 32) is None
