import pytest
import torch

from lightning_modules.motion import ClassicalFlow, ZeroFlow
from spikekit import mosaic, spike_integrate_fire

TIMES = (5, 20, 35)


def moving(velocity, height=48, width=64, pattern="RGGB"):
    """A smooth coloured texture that moves by ``velocity`` (x, y) sensor pixels a frame."""
    generator = torch.Generator().manual_seed(1)
    waves = torch.rand(3, 12, 4, generator=generator, dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    light = []
    for clock in range(41):
        u, v = x - velocity[0] * (clock - 20), y - velocity[1] * (clock - 20)
        phase = sum((w - 0.5) * 1.2 * axis[..., None, None] for w, axis in ((waves[..., 0], u), (waves[..., 1], v)))
        rgb = (torch.cos(phase + 6.3 * waves[..., 2]) * waves[..., 3]).mean(-1).movedim(-1, 0) * 0.6 + 0.5
        light.append(0.4 * mosaic(rgb.clamp(0, 1), pattern))
    charge = torch.rand(height, width, generator=generator)
    return spike_integrate_fire(torch.stack(light).float(), charge=charge)[0][None]


@pytest.mark.parametrize("velocity", [(0.2, 0.0), (0.0, -0.15), (-0.1, 0.1)])
@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_classical_flow_finds_a_translation(velocity, pattern):
    to_first, to_last = ClassicalFlow()(moving(velocity, pattern=pattern), TIMES, pattern)
    truth = 15 * torch.tensor(velocity).reshape(1, 2, 1, 1)
    for flow, expected in ((to_first, -truth), (to_last, truth)):
        error = (flow - expected).norm(dim=1)[..., 8:-8, 8:-8]
        assert error.mean() < 0.35, error.mean()


def test_time_reversed_swaps_the_flows():
    spikes = moving((0.2, 0.1))
    forward = ClassicalFlow()(spikes, TIMES, "RGGB")
    backward = ClassicalFlow()(spikes.flip(1), TIMES, "RGGB")
    for flow, other in zip(forward, reversed(backward), strict=True):
        assert (flow - other).norm(dim=1)[..., 8:-8, 8:-8].mean() < 0.2


@pytest.mark.parametrize("size", [(33, 35), (5, 4), (3, 3)])
def test_any_size(size):
    for estimator in (ClassicalFlow(), ZeroFlow()):
        for flow in estimator((torch.rand(2, 41, *size) < 0.4).to(torch.uint8), TIMES, "RGGB"):
            assert flow.shape == (2, 2, *size)
            assert flow.isfinite().all()


def test_wrong_radius():
    with pytest.raises(ValueError, match="radius"):
        ClassicalFlow(radius=0)
