import pytest
import torch

from lightning_modules.module import SuperResolution
from lightning_modules.networks import CSCSR, ClassicalDecoder

TINY = {"width": 4, "representation_width": 4, "features": 2, "stages": 1, "blocks": 1, "end_blocks": 1}


def clip(height=24, width=32):
    generator = torch.Generator().manual_seed(0)
    spikes = (torch.rand(1, 41, height, width, generator=generator) < 0.3).to(torch.uint8)
    return spikes, 2 * torch.randn(1, 2, 2, height, width, generator=generator)


def transposed(flow):
    """Of the transposed picture: x and y change places, in it and in the vectors."""
    return torch.stack([flow[:, :, 1].mT, flow[:, :, 0].mT], dim=2)


@torch.no_grad()
@pytest.mark.parametrize("pattern", ["RGGB", "BGGR"])
def test_it_is_the_mean_of_both(pattern):
    network = CSCSR(2, **TINY, pattern=pattern)
    spikes, flow = clip()
    one, both = SuperResolution(network), SuperResolution(network, self_ensemble=True)
    with_flow = (network(spikes, flow) + network(spikes.mT, transposed(flow)).mT) / 2
    torch.testing.assert_close(both(spikes, flow), with_flow.clamp(0, 1))
    own = (network(spikes) + network(spikes.mT).mT) / 2
    torch.testing.assert_close(both(spikes), own.clamp(0, 1))
    assert (both(spikes) - one(spikes)).abs().max() > 1e-3


@torch.no_grad()
@pytest.mark.parametrize(("tile", "tolerance"), [(0, 0.0), (16, 0.0), (32, 0.1)])
def test_what_is_transposed_gives_the_transposed_picture(tile, tolerance):
    module = SuperResolution(CSCSR(3, **TINY), tile=tile, tolerance=tolerance, self_ensemble=True)
    spikes, _ = clip()
    torch.testing.assert_close(module(spikes.mT), module(spikes).mT, rtol=0, atol=1e-5)


def test_test_has_it_with_either_motion():
    module = SuperResolution(CSCSR(2, **TINY), self_ensemble=True)
    spikes, flow = clip()
    with torch.no_grad():
        pictures = module.test_step({"spikes": spikes, "flow": flow}, 0)
        assert pictures["CSCSR"].equal(module(spikes))
        assert pictures["CSCSR, true flow"].equal(module(spikes, flow))
        assert not pictures["CSCSR"].equal(pictures["CSCSR, true flow"])


@torch.no_grad()
def test_a_decoder_has_it_as_well():
    spikes, _ = clip()
    decoder = ClassicalDecoder("tfp", 2)
    expected = (decoder(spikes) + decoder(spikes.mT).mT) / 2
    torch.testing.assert_close(SuperResolution(decoder, self_ensemble=True)(spikes), expected.clamp(0, 1))


@pytest.mark.parametrize("pattern", ["GRBG", "GBRG"])
def test_other_patterns_cannot_be_transposed(pattern):
    with pytest.raises(ValueError, match=f"^self_ensemble: expected RGGB or BGGR, .* got {pattern}$"):
        SuperResolution(CSCSR(2, **TINY, pattern=pattern), self_ensemble=True)
