"""Spread of gains, estimated from textured scenes."""

import pytest
import torch

from spikekit import SensorNoise, SpikeSensor, bayer_mask
from spikekit.calibration.gain_spread import gain_spread


def _rate(noise, pattern, clocks=300, light=0.3):
    """Mean rate of a scene of edges, stripes and flat parts that moves by 12 pixels."""
    y, x = torch.meshgrid(torch.arange(72.0), torch.arange(96.0), indexing="ij")
    total = torch.zeros(72, 96)
    sensor = SpikeSensor(noise, seed=0)
    for clock in range(clocks):
        along = x - 12 * clock / clocks
        scene = 0.6 + 0.4 * (((along + y) % 40 < 12).float() - (along % 30 < 3).float()).clamp(-1, 1)
        if pattern != "grey":
            scene = scene * (bayer_mask(72, 96, pattern) * torch.tensor([0.5, 1.0, 0.7])[:, None, None]).sum(0)
        total += sensor.expose(light * scene[None])[0]
    return total / clocks


@pytest.mark.parametrize("pattern", ["grey", "GBRG"])
@pytest.mark.parametrize("spread", [0.0, 0.03, 0.06, 0.12])
def test_spread_is_found_in_spite_of_texture(pattern, spread):
    found = gain_spread(_rate(SensorNoise(gain_spread=spread), pattern), 300, 1, pattern)
    assert found == pytest.approx(spread, rel=0.2, abs=0.01)


def test_dark_or_small_pictures_tell_nothing():
    assert gain_spread(torch.full((40, 40), 0.02), 300) is None  # six spikes a pixel
    assert gain_spread(torch.full((9, 40), 0.3), 300) is None
    assert gain_spread(torch.full((19, 40), 0.3), 300, 1, "RGGB") is None


def test_rounding_of_counts_is_no_noise():
    rate = torch.linspace(0.1, 0.4, 64).expand(64, 64)
    counts = torch.stack([(rate * 41 + torch.rand(64, 64)).floor() for _ in range(8)])
    assert gain_spread(counts.mean(0) / 41, 41, 8) < 0.006
    assert gain_spread(counts.mean(0) / 41, 41 * 8) > 0.006  # as if counted without a gap
