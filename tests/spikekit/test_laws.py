"""Properties of the operators on random streams, pictures, masks and flows."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st

import spikekit as sk

SEEDS = st.integers(0, 2**31)
PATTERNS = st.sampled_from(sk.PATTERNS)
SIDES = st.integers(1, 7)
FLOATS = st.sampled_from([torch.float64, torch.float32, torch.bfloat16, torch.float16])


def rng(seed):
    return torch.Generator().manual_seed(seed)


@given(st.integers(16, 2048), st.integers(0, 2047), st.integers(0, 40), FLOATS)
def test_constant_light_gives_its_rate(light, start, half, dtype):
    """For light in multiples of 1/2048, TFP and TFI are exact up to whole spikes and whole clocks."""
    frames = 2 * (2048 // light) + 2 * half + 3
    spikes, _ = sk.spike_integrate_fire(torch.full((frames, 1, 1), light / 2048), charge=torch.tensor([[start / 2048]]))
    rate, window = light / 2048, 2 * half + 1
    inside = slice(half, frames - half)
    counts = sk.tfp(spikes, window).flatten()[inside] * window
    assert ((counts.round() == math.floor(window * rate)) | (counts.round() == math.ceil(window * rate))).all()

    times = spikes.flatten().nonzero().flatten()
    between = slice(int(times[0]) + 1, int(times[-1]) + 1)
    rates = sk.tfi(spikes.to(dtype)).flatten()
    if between.start < between.stop:
        possible = 1 / torch.tensor([math.floor(1 / rate), math.ceil(1 / rate)], dtype=torch.float64)
        assert torch.isin(rates[between], possible.to(dtype)).all()


@given(SEEDS, PATTERNS, SIDES, SIDES)
def test_mosaic_keeps_what_the_mask_keeps(seed, pattern, height, width):
    rgb = torch.randn(2, 3, height, width, generator=rng(seed))
    mask = sk.bayer_mask(height, width, pattern)
    raw = sk.mosaic(rgb, pattern)
    assert torch.equal(raw, (rgb * mask).sum(-3))
    assert torch.equal(sk.split_colors(raw, pattern).movedim(0, -3), rgb * mask)
    again = raw[:, None].expand(2, 3, height, width)
    assert torch.equal(sk.mosaic(again, pattern), raw)
    assert all(torch.equal(again[:, c][:, mask[c] > 0], rgb[:, c][:, mask[c] > 0]) for c in range(3))


@st.composite
def warps(draw):
    """A mask with at least one known pixel, a flow on and off the grid, and a number of neighbours."""
    height, width, generator = draw(SIDES), draw(SIDES), rng(draw(SEEDS))
    known = torch.rand(height, width, generator=generator) < draw(st.floats(0, 1))
    known[draw(st.integers(0, height - 1)), draw(st.integers(0, width - 1))] = True
    reach, unit = draw(st.sampled_from([(0, 1), (3, 1), (3, 2), (4, 4096), (10000, 8)]))
    flow = torch.randint(-reach * unit, reach * unit + 1, (2, 2, height, width), generator=generator) / unit
    features = torch.randn(2, 3, height, width, generator=generator)
    return features, flow, known, draw(st.integers(1, 6))


@given(warps(), st.floats(-6e4, 6e4), FLOATS)
def test_idw_of_a_constant_is_that_constant(warp, constant, dtype):
    features, flow, known, neighbors = warp
    features = torch.full_like(features, constant).to(dtype)
    warped = sk.flow_warp_idw(features, flow, known, neighbors=neighbors)
    # in half precision exactly so: shares add up to one within float32, and the sum is rounded once
    ulps = 0 if dtype in (torch.bfloat16, torch.float16) else 4
    torch.testing.assert_close(warped, features, rtol=ulps * torch.finfo(dtype).eps, atol=torch.finfo(dtype).tiny)
