"""Spread of gains, estimated from textured scenes."""

import pytest
import torch

from spikekit import SensorNoise, SpikeSensor, bayer_mask
from spikekit.calibration.gain_spread import gain_spread


def _spikes(spread, pattern):
    """Spikes of a scene of edges, stripes and flat parts that moves by 12 pixels in 300 clocks."""
    y, x = torch.meshgrid(torch.arange(72.0), torch.arange(96.0), indexing="ij")
    along = x - torch.linspace(0, 12, 300).reshape(-1, 1, 1)
    light = 0.18 + 0.12 * (((along + y) % 40 < 12).float() - (along % 30 < 3).float())
    if pattern != "grey":
        light = light * (bayer_mask(72, 96, pattern) * torch.tensor([0.5, 1.0, 0.7])[:, None, None]).sum(0)
    return SpikeSensor(SensorNoise(gain_spread=spread), seed=0).expose(light).float()


@pytest.mark.parametrize("pattern", ["grey", "GBRG"])
@pytest.mark.parametrize("spread", [0.0, 0.03, 0.06, 0.12])
def test_spread_is_found_in_spite_of_texture(pattern, spread):
    spikes = _spikes(spread, pattern)
    for parts, gap in ((1, 0), (3, 10)):
        rates = spikes.unflatten(0, (parts, -1))[:, gap:].mean(1)
        assert gain_spread(rates, 300 // parts - gap, pattern) == pytest.approx(spread, rel=0.2, abs=0.01)


@pytest.mark.parametrize("spread", [0.0, 0.06])
def test_texture_everywhere_is_no_noise_if_it_moves(spread):
    still = 0.1 + 0.2 * torch.rand(48, 112, generator=torch.Generator().manual_seed(0))
    for speed in (3, 0):
        light = torch.cat([still[:, speed * n :][:, :64].expand(100, 48, 64) for n in range(16)])
        spikes = SpikeSensor(SensorNoise(gain_spread=spread), seed=0).expose(light).float()
        found = gain_spread(spikes.unflatten(0, (4, 400)).mean(1), 400)
        assert found == pytest.approx(spread, rel=0.2, abs=0.02) if speed else found is None


@pytest.mark.parametrize("pattern", ["grey", "RGGB"])
@pytest.mark.parametrize("spread", [0.0, 0.06])
def test_texture_at_rest_is_no_noise(pattern, spread):
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    color = (bayer_mask(64, 64, pattern) * torch.tensor([0.5, 1.0, 0.7])[:, None, None]).sum(0)
    for frequency, known in ((0.7, True), (1.5, False)):  # periods of 9 and of 4 pixels
        light = 0.2 + 0.1 * (frequency * x + 0.3 * y).sin() * (frequency * y - 0.4 * x).sin()
        spikes = SpikeSensor(SensorNoise(gain_spread=spread), seed=0).expose((light * color).expand(300, 64, 64))
        found = gain_spread(spikes.float().mean(0, keepdim=True), 300, pattern)
        assert found == (pytest.approx(spread, rel=0.2, abs=0.01) if known else None)


def test_blocks_that_differ_tell_nothing():
    gain = 1 + torch.linspace(0.07, 0.3, 64) * torch.randn(1, 64, 64, generator=torch.Generator().manual_seed(0))
    assert gain_spread(0.3 * gain, 400) is None
    assert gain_spread(0.3 * (1 + (gain - 1) / 3), 400) == pytest.approx(0.03, abs=0.01)


@pytest.mark.parametrize(("dark", "bright", "spread"), [(0.1, 0.1, 0.1), (0.1, 0.5, 0.045), (0.5, 0.5, 0.0)])
def test_noise_of_light_counts_if_most_is_dark(dark, bright, spread):
    """The noise of 5 electrons per spike is that of gains of 1 / sqrt(5 n) for n spikes."""
    light = torch.full((200, 40, 48), dark)
    light[..., :16] = bright
    spikes = SpikeSensor(SensorNoise(photons=5), seed=0).expose(light).float()
    assert gain_spread(spikes.unflatten(0, (2, 100)).mean(1), 100) == pytest.approx(spread, rel=0.3, abs=0.01)


def test_dark_or_small_pictures_tell_nothing():
    assert gain_spread(torch.full((1, 40, 40), 0.02), 300) is None  # six spikes a pixel
    assert gain_spread(torch.full((1, 9, 40), 0.3), 300, "RGGB") is None


def test_rounding_of_counts_is_no_noise():
    rate = torch.linspace(0.1, 0.4, 64).expand(64, 64)
    counts = torch.stack([(rate * 41 + torch.rand(64, 64)).floor() for _ in range(8)])
    assert gain_spread(counts / 41, 41) < 0.006
    assert gain_spread(counts.mean(0, keepdim=True) / 41, 41 * 8) > 0.006  # as if counted without a gap
