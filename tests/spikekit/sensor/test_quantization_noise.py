import pytest
import torch

from spikekit import spike_integrate_fire
from spikekit.sensor.noise import flicker


@pytest.mark.parametrize("frames", [1, 7, 41])
def test_against_simulated_pixels_of_all_charges(frames):
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(2, frames, generator=generator, dtype=torch.float64) - 0.3
    got = flicker(weights, (torch.arange(64) + 0.5) / 64)
    charge = (torch.arange(50_000, dtype=torch.float64) + 0.5) / 50_000
    for level in (0, 1, 9, 20, 31, 40, 63):
        light = torch.full((frames, 1, len(charge)), (level + 0.5) / 64, dtype=torch.float64)
        spikes = spike_integrate_fire(light, charge=charge.unsqueeze(0))[0][:, 0].double()
        torch.testing.assert_close(got[:, level].double(), (weights @ spikes).var(dim=1), rtol=2e-3, atol=1e-5)


def test_a_window_of_whole_intervals_is_exact():
    """Four frames of light 1/4 contain exactly one spike for any charge; of light 1/8 none or one."""
    variance = flicker(torch.ones(1, 4), torch.tensor([0.25, 0.125]))[0]
    assert variance.tolist() == [0, 0.25]


def test_black_and_white_do_not_flicker():
    assert flicker(torch.rand(3, 41), torch.tensor([0.0, 1.0])).abs().max() < 1e-12
