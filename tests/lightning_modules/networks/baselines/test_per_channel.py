"""The star of Table 2: every Bayer sub-stream by itself."""

import pytest
import torch
import torch.nn.functional as F

from lightning_modules.networks.baselines.per_channel import per_channel
from spikekit import mosaic
from spikekit.color.cfa import bayer_sites


def ramps(height, width, scale=1):
    """Three planes, a slope of its own each; in sensor pixels, whatever the scale."""
    y, x = ((torch.arange(scale * side, dtype=torch.float64) + 0.5) / scale - 0.5 for side in (height, width))
    slopes = torch.tensor([[0.3, 0.7], [-0.2, 0.5], [0.9, -0.4]], dtype=torch.float64)
    return slopes[:, 0, None, None] * y[:, None] + slopes[:, 1, None, None] * x + 5


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("scale", [1, 2, 3, 4])
@pytest.mark.parametrize("size", [(16, 20), (15, 19)])
def test_colours_stand_where_their_pixels_are(scale, pattern, size):
    """Linear slopes, enlarged linearly, are the slopes of the picture, but for the edge."""
    raw = mosaic(ramps(*size).unsqueeze(0), pattern)

    def enlarge(planes, flows):
        assert planes.shape == (4, 1, (size[0] + 1) // 2, (size[1] + 1) // 2)
        return F.interpolate(planes, scale_factor=2 * scale, mode="bilinear", align_corners=False)

    rgb = per_channel(
        enlarge, raw.unsqueeze(1) if raw.ndim == 3 else raw, torch.zeros(1, 2, 2, *size).double(), pattern, scale
    )
    assert rgb.shape == (1, 3, scale * size[0], scale * size[1])
    inner = (..., slice(4 * scale, -4 * scale), slice(4 * scale, -4 * scale))
    torch.testing.assert_close(rgb[0][inner], ramps(*size, scale)[inner])


def test_every_sub_stream_has_its_flow_in_its_pixels():
    spikes, flow = torch.rand(2, 41, 6, 8), torch.randn(2, 2, 2, 6, 8)
    seen = []

    def reconstruct(planes, flows):
        seen.extend([planes, flows])
        return planes[:, :1].repeat_interleave(4, -1).repeat_interleave(4, -2)

    per_channel(reconstruct, spikes, flow, "GRBG", 2)
    for n, (_, row, column) in enumerate(bayer_sites("GRBG")):
        for got, whole in zip(seen, (spikes, flow / 2), strict=True):
            assert torch.equal(got[2 * n : 2 * n + 2], whole[..., row::2, column::2])
