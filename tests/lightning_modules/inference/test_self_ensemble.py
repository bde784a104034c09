import pytest
import torch

from lightning_modules.inference.predict import predict
from lightning_modules.inference.self_ensemble import self_ensemble
from lightning_modules.networks import CSCSR, ClassicalDecoder
from spikekit import bayer_mask

TINY = {"width": 4, "representation_width": 4, "features": 2, "stages": 1, "blocks": 1, "end_blocks": 1}
PATTERNS = "RGGB", "BGGR", "GRBG", "GBRG"
SIZES = (24, 32), (23, 32), (24, 31), (21, 23)


@torch.no_grad()
def test_a_given_flow_reaches_every_view():
    network, generator = CSCSR(2, **TINY), torch.Generator().manual_seed(0)
    spikes = (torch.rand(1, 41, 24, 32, generator=generator) < 0.3).to(torch.uint8)
    flow = 2 * torch.randn(1, 2, 2, 24, 32, generator=generator)
    expected = (network(spikes, flow) + network(spikes.mT, flow.flip(2).mT).mT) / 2
    torch.testing.assert_close(predict(network, spikes, flow, self_ensemble=2), expected.clamp(0, 1))


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", SIZES)
def test_every_view_keeps_the_bayer_phase(pattern, size):
    """Every view is a mosaic with the colours of the picture, at its beginning and its end."""
    mask = bayer_mask(*size, pattern)
    sites = (mask * torch.tensor([1.0, 2, 3])[:, None, None]).sum(dim=0)[None, None]
    seen = []

    def run(spikes, flow):
        height, width = spikes.shape[-2:]
        own = (bayer_mask(height, width, pattern) * torch.tensor([1.0, 2, 3])[:, None, None]).sum(dim=0)
        assert spikes[0, 0].equal(own)
        seen.append((height, width))
        return spikes.expand(-1, 3, -1, -1)

    assert self_ensemble(run, sites, None, pattern, 1, 8).equal(sites.expand(-1, 3, -1, -1))
    assert len(seen) == 8
    kept = [(height % 2, width % 2) for height, width in seen]
    assert kept == [(size[0] % 2, size[1] % 2), (size[1] % 2, size[0] % 2)] * 4  # so they end as they ended


@pytest.mark.parametrize("views", [2, 4, 8])
@pytest.mark.parametrize(("pattern", "size"), zip(PATTERNS, SIZES, strict=True))
def test_flow_is_transformed_with_every_view(pattern, size, views):
    """The run samples along the flow; a wrongly mirrored vector would sample elsewhere."""
    generator = torch.Generator().manual_seed(0)
    planes = torch.rand(1, 3, *size, generator=generator, dtype=torch.float64)
    vectors = torch.tensor([2.0, -1.0], dtype=torch.float64)[:, None, None].expand(1, 2, 2, *size)
    differing = set()

    def run(spikes, flow):
        u, v = (int(flow[0, 0, axis, 0, 0]) for axis in (0, 1))
        differing.add((u, v))
        return spikes.roll((-v, -u), (-2, -1)).repeat_interleave(2, -2).repeat_interleave(2, -1)

    result = self_ensemble(run, planes, vectors, pattern, 2, views)
    inside = (..., slice(8, -8), slice(8, -8))  # what is rolled over an edge is another pixel of each view
    torch.testing.assert_close(result[inside], run(planes, vectors)[inside])
    assert len(differing) == views


def test_invalid_view_counts_and_small_clips_are_rejected():
    with pytest.raises(ValueError, match=r"^self_ensemble: expected one of \(1, 2, 4, 8\), got 3$"):
        predict(CSCSR(2, **TINY), torch.zeros(1, 41, 8, 8), self_ensemble=3)
    with pytest.raises(ValueError, match=r"^self_ensemble: expected at least 5 x 5 sensor pixels, got 4 x 9$"):
        predict(CSCSR(2, **TINY), torch.zeros(1, 41, 4, 9), self_ensemble=2)
    assert predict(ClassicalDecoder("tfp", 2), torch.zeros(1, 41, 5, 5), self_ensemble=8).shape == (1, 3, 10, 10)
