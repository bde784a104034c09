"""Pools of scenes: reproducible batches, reuse of clips, and transforms."""

import types
from collections import Counter
from itertools import islice

import pytest
import torch

from lightning_modules.data.stills import StillScenes
from lightning_modules.motion import ClassicalFlow
from lightning_modules.networks import CSCSR
from spikekit import SensorNoise

SMALL = {"scale": 2, "patch": 8, "val_patch": 8, "train_clips": 64, "batch_size": 4, "workers": 0}
KINDS = [{"share": 0.5}, {"share": 0.5, "key_frames": 2, "every": 8, "objects": 0}]


def pool(step=0, model=None, **options):
    data = StillScenes(**{**SMALL, "pool": 8, "reuse": 2, "kinds": KINDS, **options})
    data.setup("fit")
    data.trainer = types.SimpleNamespace(
        global_step=step,
        accumulate_grad_batches=1,
        world_size=1,
        global_rank=0,
        strategy=types.SimpleNamespace(root_device=torch.device("cpu")),
        lightning_module=model,
    )
    return data.train_dataloader()


def test_batches_do_not_depend_on_the_first_step():
    whole = list(islice(pool(), 12))
    for workers in (0, 1):
        later = list(islice(pool(step=5, workers=workers), 7))
        for expected, batch in zip(whole[5:], later, strict=True):
            assert expected.keys() == batch.keys()
            assert all(torch.equal(expected[name], batch[name]) for name in batch)


def test_epochs_continue_each_other():
    scenes = pool(train_clips=20)
    assert len(scenes) == 5
    first = list(scenes)
    scenes.data.trainer.global_step = 5
    second = list(scenes)
    for batch, expected in zip(first + second, islice(pool(), 10), strict=True):
        assert torch.equal(batch["spikes"], expected["spikes"])


def test_clips_are_reused_as_set():
    scenes = pool(kinds=None, reuse=3, train_clips=240)
    means = [round(float(rgb.double().mean()), 6) for batch in islice(scenes, 60) for rgb in batch["rgb"]]
    assert Counter(Counter(means).values()).most_common(1)[0][0] == 3  # the first ones and the last ones less


def test_kinds_are_mixed_by_their_shares():
    kinds = [{"share": 3}, {"share": 1, "key_frames": 2, "every": 8, "objects": 0}]
    films = ["every" in batch for batch in islice(pool(kinds=kinds), 16)]
    assert sum(films) == 4
    film = next(batch for batch in pool(kinds=kinds) if "every" in batch)
    assert film["spikes"].shape == (2, 2, 41, 8, 8)  # as many clips as there are in a batch of single ones
    assert film["every"].tolist() == [8, 8]


def test_transformed_batches_are_consistent():
    """Spikes agree with ground truth and flow, so a wrong transform of one would be seen."""
    scenes = pool(kinds=None, patch=40, motion=4.0, brightness=(1.0, 1.0))
    wrong, error, other = [], 0.0, 0.0
    for batch in islice(scenes, 4):
        flow = torch.stack(ClassicalFlow()(batch["spikes"], (5, 20, 35), "RGGB"), dim=1)
        wrong.append((flow - batch["flow"]).abs().mean() / batch["flow"].abs().mean())
        red = torch.nn.functional.avg_pool2d(batch["rgb"][:, 0], 2)[:, ::2, ::2]
        light = batch["spikes"][:, 15:26, ::2, ::2].float().mean(dim=1) / 0.4
        error, other = error + (light - red).abs().mean(), other + (light - red.mT).abs().mean()
    assert max(wrong) < 0.8  # a wrong turn makes it 1 or more
    assert error < other / 1.5


def test_pool_estimates_motion_and_includes_noise():
    network = CSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
    model = types.SimpleNamespace(network=network, flow="estimated")
    scenes = pool(model=model, flow_patch=12, noise=SensorNoise(photons=1000), gains=(0.1, 1.0), kinds=None)
    batch = next(iter(scenes))
    assert batch["spikes"].shape == (4, 41, 8, 8)
    assert batch["motion"].shape == (4, 2, 2, 8, 8)
    assert batch["motion"].abs().max() > 0
    assert batch["noise"].shape == batch["alpha"].shape == (4,)
    assert len(set(batch["alpha"].tolist())) > 1


def test_invalid_arguments_are_rejected():
    for options, message in (
        ({"kinds": KINDS, "pool": 0}, "kinds: expected a pool"),
        ({"kinds": [{"shared": 1}], "pool": 8}, "kinds: expected arguments of StillClips"),
        ({"reuse": 0}, "reuse: expected at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            StillScenes(**SMALL, **options).setup("fit")
