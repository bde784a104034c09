"""The skip that networks are given which were published without one."""

import pytest
import torch
import torch.nn.functional as F

from lightning_modules.networks import RealRawVSR, SpikeSRNetLike, VidarSR
from spikekit import demosaic_residual, tfi, tfp

SPIKES = (torch.rand(2, 41, 12, 16, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)


@pytest.mark.parametrize("scale", [2, 3, 4])
@pytest.mark.parametrize(
    ("network", "decode"),
    [
        (lambda **settings: VidarSR(width=4, features=2, **settings), tfi),
        (lambda **settings: SpikeSRNetLike(width=8, maps=2, corrections=1, **settings), tfi),
        (lambda **settings: RealRawVSR(width=8, blocks=2, **settings), tfi),
        (lambda **settings: RealRawVSR("tfp", width=8, blocks=2, **settings), lambda spikes: tfp(spikes, 41)),
    ],
)
def test_training_starts_where_a_decoder_ends(network, decode, scale):
    made = network(scale=scale, alpha=0.5, pattern="GBRG", skip=True)
    rgb = made(SPIKES, static=True)
    picture = demosaic_residual(2 * decode(SPIKES)[:, 20], "GBRG")
    expected = F.interpolate(picture, scale_factor=scale, mode="bicubic")
    torch.testing.assert_close(rgb, expected, rtol=0, atol=1e-4)
    (rgb - 1).square().mean().backward()  # and goes on from there
    assert sum(p.grad is not None and p.grad.abs().sum() > 0 for p in made.parameters()) >= 2


@pytest.mark.parametrize("network", [VidarSR, SpikeSRNetLike])
def test_with_the_star_every_colour_starts_from_its_own_pixels(network):
    """Of a scene of one colour, the others see nothing."""
    spikes = SPIKES.clone()
    spikes[..., 1::2, :] = 1
    spikes[..., :, 1::2] = 1
    rgb = network(2, width=8, per_channel=True, skip=True)(spikes, static=True)
    torch.testing.assert_close(rgb[:, 1:], torch.full((2, 2, 24, 32), 2.5))
    assert rgb[:, 0].std() > 0.1
