"""Damaged files of every kind that lightning reads.

SPIKEKIT_FUZZ=N in the environment gives each N cases, and SPIKEKIT_FUZZ_SEED=S others: those of the seeds from S.
Weights and checkpoints as they are loaded are in test_security.py.
"""

import io
import json
import os
import warnings

import numpy as np
import pytest
import torch
import yaml

from lightning_modules.cli.arguments import with_network_of_weights
from lightning_modules.cli.errors import InputError
from lightning_modules.data.cache import ClipCache
from lightning_modules.sweep.state import RESULT, read_settings
from lightning_modules.sweep.table import collect, markdown, write_csv
from lightning_modules.sweep.trials import Trial

CONFIG = {
    "seed_everything": 0,
    "model": {"class_path": "SuperResolution", "init_args": {"weights": None, "network": {"init_args": {"width": 4}}}},
    "trainer": {"max_steps": 6, "accumulate_grad_batches": 1},
}
FINISHED = {"scores": {"psnr": 21.0, "ssim": 0.6}, "steps": 6, "seconds_per_step": 0.1, "parameters": 100}


def _json(value):
    return json.dumps(value, indent=1).encode()


def _read_results(path):
    rows = collect([Trial((name,), None, path.parent, CONFIG, {}) for name in "ab"], {})
    markdown(rows)
    write_csv(rows, path.parent / "a.csv")


def _read_trial(path):
    """Write a trial over the file; the error names the folder if the file is valid but differs."""
    other = {"trial.yaml": "budget.json", "budget.json": "trial.yaml"}[path.name]
    (path.parent / other).write_bytes(GOOD[other])
    try:
        Trial(("a",), None, path.parent, CONFIG, BUDGET).write()
    except InputError as error:
        raise InputError(str(error).replace(f"{path.parent}: ", f"{path}: ")) from error


def _read_configuration(path):
    """Read a configuration like ``lightning`` before it is parsed."""
    with_network_of_weights(["fit", "-c", str(path)])


def _read_clip(path):
    """Read a damaged cached clip, which is ignored with one warning."""
    cache, made = ClipCache(path.parent), []
    place = path.parent / KEY[:2] / f"{KEY[2:]}.npz"
    place.parent.mkdir(exist_ok=True)
    path.rename(place)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        cache.packed(KEY, lambda: made.append(1) or {"spikes": torch.zeros(4, 3, 2), "rgb": torch.zeros(3, 6, 20)})
    assert len(said) == len(made)
    if made:
        raise ValueError(str(said[0].message).replace(str(place), str(path)))


def _clip():
    np.savez(file := io.BytesIO(), spikes=np.zeros((4, 3, 2), "uint8"), rgb=np.zeros((3, 6, 20), "float32"))
    return file.getvalue()


KEY, BUDGET = "ab" * 32, {"steps": 6}
GOOD = {
    RESULT: _json(FINISHED),
    "budget.json": _json(BUDGET),
    "trial.yaml": yaml.safe_dump(CONFIG, sort_keys=False).encode(),
    "a.yaml": yaml.safe_dump(CONFIG).replace("weights", "tile").encode(),  # the name of weights would be sought
    "a.npz": _clip(),
}
READ = {
    RESULT: _read_results,
    "budget.json": _read_trial,
    "trial.yaml": _read_trial,
    "a.yaml": _read_configuration,
    "a.npz": _read_clip,
}
VALUES = {RESULT: FINISHED, "budget.json": BUDGET, "trial.yaml": CONFIG}


@pytest.mark.parametrize("name", GOOD)
def test_damaged_bytes_give_one_line(fuzz, name):
    read, errors, good = READ[name], InputError if name in VALUES else ValueError, GOOD[name]
    assert fuzz(read, lambda rng: fuzz.damage(good, rng), name, errors, 120) > 5


@pytest.mark.parametrize(("name", "value"), VALUES.items())
def test_odd_values_give_one_line(fuzz, name, value):
    assert fuzz(READ[name], lambda rng: _json(fuzz.values(value, rng)), name, InputError, 120) > 20


def test_pipe_is_rejected_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "a.yaml")
    with pytest.raises(ValueError, match=r"a.yaml: expected a file, got a pipe or a device$"):
        with_network_of_weights(["fit", "-c", str(tmp_path / "a.yaml")])
    with pytest.raises(InputError, match=r"a.yaml: .*a pipe"):
        read_settings(tmp_path / "a.yaml")
