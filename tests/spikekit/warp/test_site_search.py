"""The site-wise search against bilinear upsampling and flow_warp_idw, and its derivative against autograd."""

import pytest
import torch
import torch.nn.functional as F

from spikekit import bayer_mask, flow_warp_idw
from spikekit.color.cfa import count_colors
from spikekit.warp.site_search import STEPS, search_sites, site_table

CPU = torch.device("cpu")
SHARES = torch.tensor([[1.0, 0.0], [0.5, 0.0], [0.0, 0.25], [0.0, 1.0]])


def table_for(size, pattern="RGGB", color=0, scale=4, neighbors=4):
    return site_table(pattern, color, scale, (size[0] % 2 == 1, size[1] % 2 == 1), CPU, neighbors)


def rounded_flow(size, generator, reach=5.0):
    """Flows on the steps of the border classes, so that nothing is rounded."""
    whole = torch.randint(round(-reach * STEPS / 8), round(reach * STEPS / 8), (2, 2, 2, *size), generator=generator)
    return whole * 8 / STEPS


def searched(features, flow, pattern, color, scale, neighbors=4):
    """Upsample, warp every temporal pixel by the flow of its site, at most half a pixel outside, and fold."""
    batch, times, channels, height, width = features.shape
    moved = torch.einsum("tk,bkchw->btchw", SHARES.double(), flow.double()).flatten(0, 1) * scale
    moved = moved.repeat_interleave(scale, -2).repeat_interleave(scale, -1)
    for axis, length in ((0, scale * width), (1, scale * height)):
        at = torch.arange(length).reshape((1, -1) if axis == 0 else (-1, 1))
        moved[:, axis] = (moved[:, axis] + at).clamp(-0.5, length - 0.5) - at
    pixels = features.flatten(0, 1)
    if scale > 1:
        pixels = F.interpolate(pixels, scale_factor=scale, mode="bilinear", align_corners=False)
    mask = bayer_mask(height, width, pattern, scale=scale, dtype=torch.bool)[color]
    found = F.pixel_unshuffle(flow_warp_idw(pixels, moved, mask, neighbors=neighbors), scale)
    return found.reshape(batch, times * channels * scale**2, height, width)


@pytest.mark.parametrize(
    ("scale", "pattern", "size"),
    [
        (1, "RGGB", (12, 13)),
        (1, "grey", (15, 20)),
        (3, "GBRG", (15, 20)),
        (3, "grey", (12, 13)),
        (4, "RGGB", (15, 20)),
        (4, "GBRG", (12, 13)),
    ],
)
def test_equals_upsampling_followed_by_flow_warp_idw_up_to_the_border(scale, pattern, size):
    generator = torch.Generator().manual_seed(scale)
    features = torch.randn(2, 4, 2, *size, dtype=torch.float64, generator=generator)
    flow = rounded_flow(size, generator)
    for color in range(count_colors(pattern)):
        table = table_for(size, pattern, color, scale)
        expected = searched(features, flow, pattern, color, scale)
        torch.testing.assert_close(search_sites(features, flow, SHARES, table), expected, rtol=0, atol=1e-5)
        single = search_sites(features.float(), flow, SHARES, table)  # by compiled loops, where there are such
        torch.testing.assert_close(single.double(), expected, rtol=0, atol=2e-5)
        half = features.bfloat16()  # the result is rounded to the nearest
        exact = search_sites(half.float(), flow, SHARES, table)
        torch.testing.assert_close(search_sites(half, flow, SHARES, table).float(), exact, rtol=2**-7.9, atol=1e-6)


@pytest.mark.parametrize("pattern", ["RGGB", "grey"])
def test_a_single_neighbour_is_the_nearest(pattern):
    size, generator = (13, 14), torch.Generator().manual_seed(0)
    features, flow = torch.randn(2, 4, 3, *size, generator=generator), rounded_flow(size, generator)
    for scale in (1, 2):
        found = search_sites(features, flow, SHARES, table_for(size, pattern, 0, scale, neighbors=1))
        expected = searched(features.double(), flow, pattern, 0, scale, neighbors=1).float()
        torch.testing.assert_close(found, expected, rtol=0, atol=2e-5)


def test_flow_is_rounded_to_the_nearest_step():
    size = 24, 24
    features = torch.randn(1, 4, 1, *size)
    flow = torch.full((1, 2, 2, *size), 8.0) / STEPS
    near = search_sites(features, flow + 0.4 / STEPS, SHARES, table_for(size))
    exact = search_sites(features, flow, SHARES, table_for(size))
    inside = ..., slice(4, -4), slice(4, -4)  # at the border steps are twice as long
    assert torch.equal(near[:, 3 * 16 :][inside], exact[:, 3 * 16 :][inside])  # the last time point has all of the flow


def test_infinite_or_huge_flow_ends_at_the_border():
    size = 14, 12
    features, flow = torch.randn(1, 4, 2, *size), torch.zeros(1, 2, 2, *size)
    flow[0, :, :, 3, 4], flow[0, :, 0, 5, 5], flow[0, :, 0, 6, 6] = torch.nan, torch.inf, -1e30
    beyond = torch.zeros_like(flow)
    beyond[0, :, 0, 5, 5], beyond[0, :, 0, 6, 6] = 4.0 * size[1], -4.0 * size[1]
    for dtype in (torch.float32, torch.float64):
        found = search_sites(features.to(dtype), flow, SHARES, table_for(size))
        torch.testing.assert_close(found, search_sites(features.to(dtype), beyond, SHARES, table_for(size)))


@pytest.mark.parametrize(("scale", "channels"), [(1, 3), (4, 2)])
def test_the_derivative_is_the_adjoint(scale, channels):
    size = 13, 16
    generator = torch.Generator().manual_seed(0)
    flow = torch.randn(2, 2, 2, *size, generator=generator) * 3
    table = table_for(size, scale=scale)
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 1e-4)):
        features = torch.randn(2, 4, channels, *size, dtype=dtype, generator=generator).requires_grad_()
        found = search_sites(features, flow, SHARES, table)
        grad = torch.randn(found.shape, dtype=dtype, generator=generator)
        found.backward(grad)
        # linear: <A f, g> = <f, A^T g>, for every f
        other = torch.randn(features.shape, dtype=dtype, generator=generator)
        ahead = (search_sites(other, flow, SHARES, table) * grad).sum()
        torch.testing.assert_close((other * features.grad).sum(), ahead, rtol=tolerance, atol=tolerance)


def test_results_have_their_channels_last_and_compile_in_one_graph():
    size = 12, 12
    features, flow, table = torch.randn(1, 4, 1, *size), torch.randn(1, 2, 2, *size), table_for(size)
    found = search_sites(features, flow, SHARES, table)
    assert found.is_contiguous(memory_format=torch.channels_last)
    compiled = torch.compile(
        lambda features, flow: search_sites(features, flow, SHARES, table), backend="aot_eager", fullgraph=True
    )
    torch.testing.assert_close(compiled(features, flow), found)
