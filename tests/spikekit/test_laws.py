"""Laws of the camera, on streams, pictures, masks and flows of any kind.

Laws that stand elsewhere, by hypothesis too: charge is conserved, light below zero is a debt, and the sensor in chunks
equals one run (test_sensor); the decoders in chunks equal the whole (test_streams); TFP of a whole clip is its rate
(test_decoders).
"""

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
    """Of light in 2048ths of the threshold: TFP and TFI are as near to it as whole spikes and whole clocks allow."""
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


@given(SEEDS, st.integers(0, 12), st.integers(0, 12), st.floats(0, 1), st.sampled_from([1, 3, 11]))
def test_a_shifted_stream_is_decoded_shifted(seed, before, after, density, window):
    """What lies outside the window, or beyond the enclosing spikes, does not matter; nor does the clip's start."""
    frames = 30
    inner = (torch.rand(frames, 2, 3, generator=rng(seed)) < density).float()
    inner[[0, -1]] = 1  # so that every frame is enclosed
    around = torch.rand(2, 12, 2, 3, generator=rng(seed + 1)).round()
    shifted = torch.cat([around[0, :before], inner, around[1, :after]])
    here = slice(before, before + frames)
    for decode in (sk.tfi, sk.spike_interval):
        assert torch.equal(decode(shifted)[here][1:], decode(inner)[1:])
    half = window // 2
    inside = slice(before + half, before + frames - half)
    assert torch.equal(sk.tfp(shifted, window)[inside], sk.tfp(inner, window)[half : frames - half])


@given(SEEDS, st.integers(1, 41), st.floats(0, 1), st.sampled_from([1, 3, 11, 99]))
def test_a_reversed_stream(seed, frames, density, window):
    """TFP is symmetric in time; TFI is so between spikes, one frame later, as a spike closes its interval."""
    spikes = (torch.rand(frames, 2, 3, generator=rng(seed)) < density).float()
    assert torch.equal(sk.tfp(spikes.flip(0), window), sk.tfp(spikes, window).flip(0))
    previous, following = spikes.cumsum(0) - spikes > 0, spikes.flip(0).cumsum(0).flip(0) > 0
    enclosed = (previous & following)[1:]
    assert torch.equal(sk.tfi(spikes.flip(0)).flip(0)[:-1][enclosed], sk.tfi(spikes)[1:][enclosed])


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


@given(SEEDS, PATTERNS, SIDES, SIDES, st.integers(1, 3))
def test_bayer_phases_are_each_others_shifts_and_flips(seed, pattern, height, width, scale):
    upper, lower = pattern[:2], pattern[2:]
    mask = sk.bayer_mask(height, width, pattern, scale=scale)
    right, down = upper[::-1] + lower[::-1], lower + upper
    both = right[2:] + right[:2]
    # shifted by one sensor pixel
    wider = sk.bayer_mask(height + 1, width + 1, pattern, scale=scale)
    assert torch.equal(wider[:, :-scale, scale:], sk.bayer_mask(height, width, right, scale=scale))
    assert torch.equal(wider[:, scale:, :-scale], sk.bayer_mask(height, width, down, scale=scale))
    assert torch.equal(wider[:, scale:, scale:], sk.bayer_mask(height, width, both, scale=scale))
    # flipped: the same phase where the side is odd
    assert torch.equal(mask.flip(-1), sk.bayer_mask(height, width, pattern if width % 2 else right, scale=scale))
    assert torch.equal(mask.flip(-2), sk.bayer_mask(height, width, pattern if height % 2 else down, scale=scale))
    # and so is what is made with them
    rgb = torch.randn(3, 2 * height, 2 * width, generator=rng(seed))
    assert torch.equal(sk.mosaic(rgb.flip(-1), pattern), sk.mosaic(rgb, right).flip(-1))
    assert torch.equal(sk.mosaic(rgb.flip(-2), pattern), sk.mosaic(rgb, down).flip(-2))
    rolled = rgb.roll((1, 1), (-2, -1))
    assert torch.equal(sk.mosaic(rolled, pattern), sk.mosaic(rgb, both).roll((1, 1), (-2, -1)))


@st.composite
def warps(draw):
    """A mask that knows at least one pixel, a flow on and off the grid, and how many neighbours count."""
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
