"""Training with motion that is estimated on more than the patch."""

import pytest
import torch
import torch.nn.functional as F

from lightning_modules.data import StillScenes
from lightning_modules.motion import ClassicalFlow, ZeroFlow
from lightning_modules.networks import CSCSR
from lightning_modules.tasks.super_resolution import SuperResolution


@pytest.mark.parametrize(
    ("flow", "motion", "key_frames"),
    [
        ("estimated", ClassicalFlow, 1),
        ("estimated", ClassicalFlow, 2),
        ("estimated", ZeroFlow, 1),
        ("scene", ClassicalFlow, 1),  # several key frames come without a flow
    ],
)
def test_margin_serves_only_motion_estimation(flow, motion, key_frames):
    sizes = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "end_blocks": 1}
    network = CSCSR(scale=2, **sizes, motion=motion())
    module = SuperResolution(network, flow=flow)
    module.log = lambda *_, **__: None
    sizes = {"patch": 8, "flow_patch": 24, "train_clips": 2, "batch_size": 2}
    data = StillScenes(scale=2, **sizes, key_frames=key_frames, workers=0)
    data.setup("fit")
    [batch] = data.train_dataloader()
    spikes, rgb = batch["spikes"].flatten(0, -4), batch["rgb"].flatten(0, -4)
    assert spikes.shape == (2 * key_frames, 41, 24, 24)
    inner = (..., slice(8, 16), slice(8, 16))
    used = batch["flow"] if flow == "scene" else network.estimate_flow(spikes)[inner]
    expected = F.l1_loss(network(spikes[inner], used), rgb)
    torch.testing.assert_close(module.training_step(batch, 0), expected)
    if motion is ClassicalFlow:
        assert (network.estimate_flow(spikes[inner]) - used).abs().max() > 0.01  # what the patch alone says
