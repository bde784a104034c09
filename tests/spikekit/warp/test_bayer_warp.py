"""The exportable warp against flow_warp_idw."""

import pytest
import torch

from spikekit import bayer_mask, flow_warp_idw
from spikekit.warp.bayer_warp import bayer_warp_idw


def rounded(flow):
    """Flow in multiples of 1/16 pixel, at most half a pixel outside the picture."""
    height, width = flow.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixel, last = torch.stack([x, y]), torch.tensor([width, height]).reshape(2, 1, 1) - 0.5
    moved = (flow.double().nan_to_num(0) + pixel).clamp(min=-0.5).minimum(last)
    return ((moved - pixel) * 16).round() / 16


@pytest.mark.parametrize(
    ("pattern", "neighbors", "scale"),
    [("RGGB", 4, 1), ("GBRG", 4, 2), ("BGGR", 1, 3), ("RGGB", 4, 4), ("grey", 4, 2), ("grey", 1, 1)],
)
def test_equals_flow_warp_idw(pattern, neighbors, scale):
    generator = torch.Generator().manual_seed(scale)
    for height, width in ((8, 10), (20, 14)):
        features = torch.rand(2, 3, scale * height, scale * width, generator=generator)
        flow = 6 * torch.randn(2, 2, scale * height, scale * width, generator=generator)
        flow[:, :, ::3] = (2 * flow[:, :, ::3]).round() / 2  # where neighbours are equally far
        flow[0, 0, 0, 0], flow[0, 1, 1, 1] = float("nan"), 1e9
        for color, mask in enumerate(bayer_mask(height, width, pattern, scale=scale)):
            got = bayer_warp_idw(features, flow, pattern, color, scale, 16, neighbors)
            expected = flow_warp_idw(features, rounded(flow), mask, neighbors=neighbors)
            torch.testing.assert_close(got, expected, rtol=0, atol=1e-5)
