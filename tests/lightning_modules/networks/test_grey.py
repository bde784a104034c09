"""Networks for grey sensors."""

from __future__ import annotations

import pytest
import torch

from lightning_modules.motion import ClassicalFlow, Spike2Flow, ZeroFlow
from lightning_modules.networks import CSCSR, ClassicalDecoder

TINY = {"width": 8, "representation_width": 8, "features": 2, "stages": 2, "end_blocks": 1, "pattern": "grey"}


def _spikes(*size: int) -> torch.Tensor:
    return (torch.rand(size, generator=torch.Generator().manual_seed(0)) < 0.4).float()


@pytest.mark.parametrize(("scale", "resolution"), [(1, "output"), (1, "sensor"), (2, "output"), (3, "sensor")])
def test_grey_picture_has_one_channel_at_any_scale_and_size(scale, resolution):
    spikes = _spikes(2, 41, 11, 14)
    network = CSCSR(scale, resolution=resolution, skip=True, **TINY)
    flow = torch.randn(2, 2, 2, 11, 14, generator=torch.Generator().manual_seed(1))
    for picture in (network(spikes), network(spikes, flow), network(spikes, static=True)):
        assert picture.shape == (2, 1, 11 * scale, 14 * scale)
    assert ClassicalDecoder(scale=scale, pattern="grey")(spikes).shape == (2, 1, 11 * scale, 14 * scale)


@pytest.mark.parametrize(("pattern", "scale"), [("grey", 1), ("RGGB", 1), ("RGGB", 3)])
def test_search_finds_pixels_that_moved_by_whole_pixels(pattern, scale):
    """With its true flow, a clip that moves by two pixels per time point gives the result of a still clip."""
    network = CSCSR(scale, **{**TINY, "pattern": pattern, "representation": "spikes", "window": 1, "stride": 10})
    scene, times = torch.rand(80, 80, generator=torch.Generator().manual_seed(0)), network.times
    if pattern != "grey":  # whole Bayer cells have one colour
        scene = scene.reshape(40, 2, 40, 2).mean(dim=(1, 3)).repeat_interleave(2, 0).repeat_interleave(2, 1)
    moving = torch.stack([scene[20:60, 20 - (n // 10 - 2) * 2 :][:, :40] for n in range(41)])[None]
    resting = scene[20:60, 20:60].expand(1, 41, 40, 40)
    flow = torch.zeros(1, 2, 2, 40, 40)
    flow[:, :, 0] = torch.tensor([-4.0, 4.0]).reshape(2, 1, 1)
    assert times == (0, 10, 20, 30, 40)
    inside = (..., slice(10 * scale, -10 * scale), slice(10 * scale, -10 * scale))
    found, expected = network(moving, flow), network(resting, static=True)
    torch.testing.assert_close(found[inside], expected[inside])


@pytest.mark.parametrize("estimator", [ClassicalFlow(), ZeroFlow(), Spike2Flow()], ids=lambda kind: type(kind).__name__)
def test_motion_is_estimated_on_all_pixels_of_a_grey_sensor(estimator):
    spikes = _spikes(2, 41, 21, 18)
    to_first, to_last = estimator(spikes, (5, 20, 35), "grey")
    assert to_first.shape == to_last.shape == (2, 2, 21, 18)
    assert estimator.channel_flows(spikes, (5, 20, 35), "grey")[0].shape == (1, 2, 2, 21, 18)


def test_untrained_network_returns_the_firing_rate_of_a_still_scene():
    spikes = torch.zeros(1, 41, 24, 24)
    spikes[:, ::2, :, :12] = 1
    spikes[:, ::4, :, 12:] = 1
    picture = CSCSR(1, skip=True, alpha=1.0, **TINY)(spikes, static=True)
    assert (picture[..., :12] - 1 / 2).abs().max() < 0.002
    assert (picture[..., 12:] - 1 / 4).abs().max() < 0.002
