"""Networks, motion and tiles on the device of pretend.py; run by test_other_device.py in a process of its own."""

import copy
from pathlib import Path

import pretend
import pytest
import torch
from test_ablations import TINY, clip, variant

from lightning_modules.inference.tiles import forward_in_tiles
from lightning_modules.motion import ClassicalFlow, Spike2Flow, ZeroFlow
from lightning_modules.networks import CSCSR

DEVICE = pretend.DEVICE
LIBRARY = pretend.register()
CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize("letter", "abcdefghij")
def test_networks_train(letter):
    network = variant(letter, CONFIGS)
    spikes, flow = clip()
    flow = flow[:, None].expand(-1, 3, -1, -1, -1, -1) if letter == "d" else flow
    moved = copy.deepcopy(network).to(DEVICE)
    for one, place in ((network, "cpu"), (moved, DEVICE)):
        one(spikes.to(place), flow.to(place)).square().mean().backward()
    for one, other in zip(moved.parameters(), network.parameters(), strict=True):
        assert (one.grad is None) == (other.grad is None)
        if other.grad is not None:
            torch.testing.assert_close(one.grad.cpu(), other.grad, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("motion", [ZeroFlow, ClassicalFlow, Spike2Flow])
def test_motion_is_estimated(motion, dtype):
    torch.manual_seed(0)
    network = CSCSR(2, **TINY, motion=motion()).to(dtype)
    spikes, _ = clip(height=24, width=32)
    with torch.no_grad():
        expected = network(spikes)
        got = network.to(DEVICE)(spikes.to(DEVICE))
    assert got.device == DEVICE
    assert got.dtype == dtype
    torch.testing.assert_close(got.cpu().float(), expected.float(), rtol=0, atol=0.05)  # motion of chance is loose


def test_nothing_waits_for_the_device():
    """With motion given, from the second picture of a size on."""
    network = CSCSR(2, **TINY).to(DEVICE)
    spikes, flow = (tensor.to(DEVICE) for tensor in clip())
    network(spikes, flow).sum().backward()
    pretend.waits.clear()
    network(spikes, flow).sum().backward()
    assert pretend.waits == []


def test_tiles_are_computed_there():
    torch.manual_seed(0)
    network = CSCSR(2, **TINY, motion=ZeroFlow())
    spikes, _ = clip(height=40, width=56)
    expected = forward_in_tiles(network, spikes, 24)
    got = forward_in_tiles(network.to(DEVICE), spikes.to(DEVICE), 24)
    torch.testing.assert_close(got.cpu(), expected, rtol=0, atol=1e-4)
