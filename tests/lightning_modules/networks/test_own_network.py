"""User-defined networks and estimators, compiled networks, and networks shared by threads."""

import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from lightning_modules.motion import MotionEstimator, ZeroFlow
from lightning_modules.networks import CSCSR, Network
from lightning_modules.storage.pretrained import Weights, motion_of, settings_of, write_weights
from lightning_modules.tasks.super_resolution import SuperResolution
from spikekit import bayer_mask

TINY = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "end_blocks": 1}
LEAST = {"frames": 3, "window": 1, "stride": 1, "representation": "spikes", "refinement": False}
SPIKES = (torch.rand(1, 41, 12, 10, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)


class Mean(Network):
    """The example in the documentation of training."""

    def __init__(self, scale=4, frames=41):
        super().__init__()
        self.scale, self.frames = scale, frames
        self.head = torch.nn.Conv2d(3, 3 * scale**2, 5, padding=2)

    def forward(self, spikes, flow=None):
        rate = spikes.float().mean(1, keepdim=True)
        return torch.nn.functional.pixel_shuffle(self.head(rate * bayer_mask(*rate.shape[-2:])), self.scale)


class Steady(MotionEstimator):
    def __init__(self):
        super().__init__()
        self.speed = torch.nn.Parameter(torch.ones(2, 1, 1))

    def forward(self, spikes, times, pattern):
        flow = self.speed.expand(len(spikes), 2, *spikes.shape[-2:])
        return -flow, flow


def saved(path, network):
    content = {"state_dict": SuperResolution(network).state_dict()}
    SuperResolution(network).on_save_checkpoint(content)
    torch.save(content, path.with_suffix(".ckpt"))
    weights = Weights(path, settings_of(network), motion_of(network), network.state_dict())
    write_weights(weights, path.with_suffix(".safetensors"))
    return path.with_suffix(".ckpt"), path.with_suffix(".safetensors")


def test_user_defined_network_can_be_trained_tested_and_loaded(tmp_path):
    network = Mean(scale=2)
    module = SuperResolution(network)
    batch = {"spikes": SPIKES, "rgb": torch.rand(1, 3, 24, 20), "flow": torch.zeros(1, 2, 2, 12, 10)}
    module.log = lambda *_, **__: None
    module.training_step(batch, 0).backward()
    assert network.head.weight.grad.any()
    assert {"Mean", "TFI"} <= module.test_step(batch, 0)["pictures"].keys()
    for path in saved(tmp_path / "mean", network):
        read = Mean.from_pretrained(path)
        assert (read.scale, read.frames, read.pattern) == (2, 41, "RGGB")
        assert torch.equal(read(SPIKES), network(SPIKES))


def test_user_defined_estimator_is_loaded_with_its_weights(tmp_path):
    estimator = Steady()
    torch.nn.init.constant_(estimator.speed, 0.5)
    network = CSCSR(2, **TINY, motion=estimator)
    for path in saved(tmp_path / "steady", network):
        with pytest.raises(ValueError, match="Steady"):
            CSCSR.from_pretrained(path)  # files cannot build classes outside the package
        assert torch.equal(CSCSR.from_pretrained(path, motion=Steady())(SPIKES), network(SPIKES))
        assert CSCSR.from_pretrained(path, motion=ZeroFlow()).motion.static


def test_compiled_network_is_saved_without_its_wrapper(tmp_path):
    network = CSCSR(2, **TINY, motion=ZeroFlow())
    compiled = torch.compile(network, backend="eager")
    for path in saved(tmp_path / "compiled", compiled):
        assert torch.equal(CSCSR.from_pretrained(path)(SPIKES, static=True), network(SPIKES))
        SuperResolution(torch.compile(CSCSR(2, **TINY), backend="eager"), weights=str(path))


def test_compiled_network_handles_validation_before_training():
    """Validation with estimated motion, then training on smaller clips with given motion."""
    network = CSCSR(2, **TINY, **LEAST).eval()
    compiled = torch.compile(network, backend="eager")
    for side, own in ((16, True), (8, False)):
        spikes = (torch.rand(1, 3, side, side) < 0.3).float()
        flow = None if own else torch.rand(1, 2, 2, side, side)
        with torch.set_grad_enabled(not own):
            torch.testing.assert_close(compiled(spikes, flow), network(spikes, flow))


def test_checkpoint_can_be_loaded_without_a_configuration(tmp_path):
    network = CSCSR(2, **TINY, motion=ZeroFlow())
    path, _ = saved(tmp_path / "alone", network)
    module = SuperResolution.load_from_checkpoint(path)
    assert module.network.training
    assert torch.equal(module.network(SPIKES, static=True), network(SPIKES))


def test_network_is_thread_safe():
    """Many small sizes stress the caches by size."""
    network = CSCSR(2, **TINY, **LEAST, motion=ZeroFlow()).eval()
    generator = torch.Generator().manual_seed(0)
    sizes = [(height, width) for height in range(3, 7) for width in range(3, 7)]
    clips = [(torch.rand(1, 3, *size, generator=generator) < 0.3).to(torch.uint8) for size in sizes]

    def picture(spikes):
        with torch.inference_mode():
            return network(spikes)

    expected = [picture(clip) for clip in clips]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as threads:
            made = list(threads.map(picture, clips * 10))
    finally:
        sys.setswitchinterval(before)
    for one, other in zip(made, expected * 10, strict=True):
        assert torch.equal(one, other)
