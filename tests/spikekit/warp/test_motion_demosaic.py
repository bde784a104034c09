"""Demosaicing along motion against loops over pixels in float64, and on scenes of known motion."""

import math

import pytest
import torch

from spikekit import (
    bayer_mask,
    demosaic_along_motion,
    demosaic_residual,
    flow_warp,
    linear_motion,
    mosaic,
    psnr,
    simulate_spikes,
    tfi_at,
)
from spikekit.color.residual_demosaic import guided_by_green, interpolate_green
from spikekit.scenes.analytic import Layer, Motion, Scene


def correct(estimate, raw, flow, mask):
    """Correct one colour, pixel by pixel; raw (T, H, W), flow (T, 2, H, W)."""
    frames, height, width = raw.shape
    moved = [flow_warp(estimate[None], -flow[t])[0] for t in range(frames)]
    result = estimate.clone()
    for y in range(height):
        for x in range(width):
            total = weights = 0.0
            for t in range(frames):
                at_x, at_y = x + flow[t, 0, y, x].item(), y + flow[t, 1, y, x].item()
                near_x, near_y = min(max(round(at_x), 1), width - 2), min(max(round(at_y), 1), height - 2)
                for b in range(near_y - 1, near_y + 2):
                    for a in range(near_x - 1, near_x + 2):
                        if mask[b, a]:
                            off = (raw[t, b, a] - moved[t][b, a]).item()
                            square = (a - at_x) ** 2 + (b - at_y) ** 2
                            weight = math.exp(-square / (2 * 0.5**2) - abs(t - frames // 2) / 5)
                            weight *= math.exp(-(off**2) / (2 * 0.5**2))
                            total, weights = total + weight * off, weights + weight
            result[y, x] += total / weights
    return result


@pytest.mark.parametrize("pattern", ["RGGB", "GRBG"])
def test_pictures_equal_those_of_loops(pattern):
    generator = torch.Generator().manual_seed(0)
    raw = torch.rand(3, 6, 7, dtype=torch.float64, generator=generator)
    flow = 3 * torch.randn(3, 2, 6, 7, dtype=torch.float64, generator=generator)
    flow[1] = 0
    red, green, blue = bayer_mask(6, 7, pattern, dtype=torch.bool)
    greens = correct(interpolate_green(raw[1:2], green)[0], raw, flow, green)
    planes = [correct(guided_by_green(raw[1:2], greens[None], mask)[0], raw, flow, mask) for mask in (red, blue)]
    got = demosaic_along_motion(raw, flow, pattern)
    torch.testing.assert_close(got, torch.stack([planes[0], greens, planes[1]]), rtol=0, atol=1e-7)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_single_mosaic_equals_residual_interpolation(pattern):
    """A mosaic does not deviate from its own samples."""
    raw = torch.rand(2, 1, 8, 9, dtype=torch.float64)
    got = demosaic_along_motion(raw, torch.zeros(2, 1, 2, 8, 9, dtype=torch.float64), pattern)
    torch.testing.assert_close(got, demosaic_residual(raw[:, 0], pattern))


def scene(velocity):
    """A uniformly moving photograph: spikes, ground truth and offsets at five times."""
    from skimage import data

    picture = torch.tensor(data.astronaut()[:160, 160:320]).movedim(-1, 0) / 255
    moving = Scene([Layer(picture, Motion((velocity, velocity / 2)), (-32, -32))], 96, 96)
    spikes = simulate_spikes(moving.light("RGGB", scale=1, alpha=0.4), generator=torch.Generator().manual_seed(0))
    times = [10, 15, 20, 25, 30]
    flow = [moving.flow(clock, scale=1) for clock in (5, 35)]
    offsets = linear_motion(*flow, times, first=5, middle=20, last=35)
    return torch.stack([tfi_at(spikes, n) for n in times]) / 0.4, moving.rgb(20), offsets


@pytest.mark.parametrize("velocity", [0.0, 0.15])
def test_known_motion_improves_the_picture(velocity):
    raw, truth, flow = scene(velocity)
    one = psnr(demosaic_residual(raw[2]), truth)
    assert psnr(demosaic_along_motion(raw, flow), truth) > one + 1


def test_outliers_are_rejected():
    """A mosaic with other content changes little."""
    raw, _, flow = scene(0.0)
    other = raw.clone()
    other[0] = mosaic(torch.rand(3, 96, 96, generator=torch.Generator().manual_seed(1)) + 3)
    assert (demosaic_along_motion(other, flow) - demosaic_along_motion(raw, flow)).abs().mean() < 0.01


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e4])
def test_pictures_are_finite_for_any_flow(value):
    raw = torch.rand(3, 6, 8, dtype=torch.float64)
    flow = torch.zeros(3, 2, 6, 8, dtype=torch.float64)
    flow[0] = value
    got = demosaic_along_motion(raw, flow.requires_grad_())
    (grad,) = torch.autograd.grad(got.sum(), flow)
    assert got.isfinite().all()
    assert grad.isfinite().all()


@pytest.mark.parametrize(
    ("raw", "flow", "options", "message"),
    [
        (torch.rand(4, 5, 5), torch.zeros(4, 2, 5, 5), {}, r"raw: expected \(\*, T, H, W\) with T odd"),
        (torch.rand(3, 2, 5), torch.zeros(3, 2, 2, 5), {}, "raw: expected .* at least 3 x 3"),
        (torch.rand(3, 5, 5), torch.zeros(3, 2, 5, 4), {}, r"flow: expected \(3, 2, 5, 5\) for raw \(3, 5, 5\)"),
        (torch.rand(3, 5, 5), torch.zeros(3, 2, 5, 5), {"pattern": "RGBG"}, "pattern: expected one of"),
    ],
)
def test_invalid_arguments_are_rejected(raw, flow, options, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        demosaic_along_motion(raw, flow, **options)
