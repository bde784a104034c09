"""Spread of gains, estimated from textured scenes."""

import pytest
import torch

from spikekit import SensorNoise, SpikeSensor, bayer_mask
from spikekit.calibration.gain_spread import gain_spread


def _rate(spread, pattern):
    """Mean rate of a scene of edges, stripes and flat parts that moves by 12 pixels in 300 clocks."""
    y, x = torch.meshgrid(torch.arange(72.0), torch.arange(96.0), indexing="ij")
    along = x - torch.linspace(0, 12, 300).reshape(-1, 1, 1)
    light = 0.18 + 0.12 * (((along + y) % 40 < 12).float() - (along % 30 < 3).float())
    if pattern != "grey":
        light = light * (bayer_mask(72, 96, pattern) * torch.tensor([0.5, 1.0, 0.7])[:, None, None]).sum(0)
    return SpikeSensor(SensorNoise(gain_spread=spread), seed=0).expose(light).float().mean(0)


@pytest.mark.parametrize("pattern", ["grey", "GBRG"])
@pytest.mark.parametrize("spread", [0.0, 0.03, 0.06, 0.12])
def test_spread_is_found_in_spite_of_texture(pattern, spread):
    found = gain_spread(_rate(spread, pattern), 300, 1, pattern)
    assert found == pytest.approx(spread, rel=0.2, abs=0.01)


def test_dark_or_small_pictures_tell_nothing():
    assert gain_spread(torch.full((40, 40), 0.02), 300) is None  # six spikes a pixel
    assert gain_spread(torch.full((19, 40), 0.3), 300, 1, "RGGB") is None


def test_rounding_of_counts_is_no_noise():
    rate = torch.linspace(0.1, 0.4, 64).expand(64, 64)
    counts = torch.stack([(rate * 41 + torch.rand(64, 64)).floor() for _ in range(8)])
    assert gain_spread(counts.mean(0) / 41, 41, 8) < 0.006
    assert gain_spread(counts.mean(0) / 41, 41 * 8) > 0.006  # as if counted without a gap
