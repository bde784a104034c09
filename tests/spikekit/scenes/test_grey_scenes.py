"""Scenes seen by a grey sensor."""

from __future__ import annotations

import pytest
import torch

from spikekit import bin_to_sensor
from spikekit.scenes.analytic import Layer, Motion, Scene

FLOAT = torch.float64


def _scene(channels: int) -> Scene:
    generator = torch.Generator().manual_seed(0)
    pictures = [torch.rand(3, side, side, dtype=FLOAT, generator=generator) for side in (60, 9)]
    if channels == 1:
        pictures = [bin_to_sensor(picture, "grey", scale=1)[None] for picture in pictures]
    layers = [
        Layer(pictures[0], Motion(velocity=(0.3, -0.2), rotation=0.01, center=(8, 8)), (-12, -12)),
        Layer(pictures[1], Motion(velocity=(-0.4, 0.1)), (5, 6), torch.ones(9, 9, dtype=FLOAT)),
    ]
    return Scene(layers, 24, 18, 9)


@pytest.mark.parametrize("scale", [1, 2, 3])
@pytest.mark.parametrize("channels", [1, 3])
def test_grey_light_is_the_luminance_of_the_view(scale, channels):
    scene = _scene(channels)
    light = scene.light("grey", scale=scale, alpha=0.4)
    assert light.shape == (9, 24 // scale, 18 // scale)
    for clock in (0, 4, 8):
        assert scene.rgb(clock).shape == (channels, 24, 18)
        expected = 0.4 * bin_to_sensor(scene.rgb(clock), "grey", scale=scale)
        torch.testing.assert_close(light[clock], expected, rtol=1e-5, atol=1e-6)


def test_grey_pictures_equal_colour_pictures_with_equal_channels():
    torch.testing.assert_close(_scene(1).light("grey", scale=2), _scene(3).light("grey", scale=2), rtol=1e-5, atol=1e-6)
    assert torch.equal(_scene(1).flow(8, scale=2), _scene(3).flow(8, scale=2))


def test_a_bayer_sensor_needs_colours():
    with pytest.raises(ValueError, match="pattern: expected grey"):
        _scene(1).light("RGGB", scale=2)
    with pytest.raises(ValueError, match="layers"):
        Scene([Layer(torch.rand(1, 9, 9)), Layer(torch.rand(3, 4, 4), mask=torch.ones(4, 4))], 8, 8)
