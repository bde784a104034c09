"""Residual interpolation against loops over pixels in float64, and its properties."""

import math

import numpy as np
import pytest
import torch

from spikekit import bayer_mask, demosaic, demosaic_residual, mosaic, psnr

BORDER, RADIUS = 18, 5


def mirrored(plane):
    return np.pad(plane, BORDER, "reflect")


def guided(guide, known, mask, rows):
    """Fit a line in every window, and average the lines of all windows that contain a pixel."""
    height, width = guide.shape
    slope, offset = np.zeros(guide.shape), np.zeros(guide.shape)

    def window(y, x):
        return np.s_[max(y - rows, 0) : y + rows + 1, max(x - RADIUS, 0) : x + RADIUS + 1]

    for y, x in np.ndindex(height, width):
        there = mask[window(y, x)]
        if there.any():
            i, p = guide[window(y, x)][there], known[window(y, x)][there]
            slope[y, x] = np.mean((i - i.mean()) * (p - p.mean())) / max(i.var(), 1e-5)
            offset[y, x] = p.mean() - slope[y, x] * i.mean()
    lines = [
        slope[window(y, x)].mean() * guide[y, x] + offset[window(y, x)].mean() for y, x in np.ndindex(height, width)
    ]
    return np.reshape(lines, guide.shape)


def rows_apart(known, green):
    """Return green minus the other colour of the row."""
    height, width = known.shape
    beside = np.zeros_like(known)
    beside[:, 1:-1] = (known[:, :-2] + known[:, 2:]) / 2
    filled = []
    for mask in (green, ~green):
        guide = np.where(mask, beside, known)
        tentative = guided(guide, known, mask, 0)
        left = known - tentative
        plane = known.copy()
        for y in range(height):
            for x in range(1, width - 1):
                if not mask[y, x]:
                    plane[y, x] = tentative[y, x] + (left[y, x - 1] + left[y, x + 1]) / 2
        filled.append(plane)
    return filled[0] - filled[1]


def residual_interpolation(raw, pattern):
    height, width = raw.shape
    masks = bayer_mask(height, width, pattern, dtype=torch.bool).numpy()
    known, green = mirrored(raw), np.pad(masks[1], BORDER, "reflect")
    difference = {"x": rows_apart(known, green), "y": rows_apart(known.T, green.T).T}
    fade = [math.exp(-(k**2) / (2 * 2.0**2)) for k in range(5)]
    greens = raw.copy()
    for y, x in np.ndindex(height, width):
        if masks[1, y, x]:
            continue
        total = weights = 0.0
        for axis, d in difference.items():
            step = (0, 1) if axis == "x" else (1, 0)

            def change(b, a, d=d, step=step):
                return abs(d[b + step[0], a + step[1]] - d[b - step[0], a - step[1]])

            for side in (-1, 1):
                at = (y + BORDER, x + BORDER)
                middle = [at[i] + 2 * side * step[i] for i in range(2)]
                changes = sum(change(middle[0] + i, middle[1] + j) for i in range(-2, 3) for j in range(-2, 3))
                weight = 1 / (changes**2 + 1e-6)
                seen = [d[at[0] + side * k * step[0], at[1] + side * k * step[1]] for k in range(5)]
                total += weight * np.dot(fade, seen) / sum(fade)
                weights += weight
        greens[y, x] += total / weights
    planes = [None, greens, None]
    for c in (0, 2):
        mask, guide = np.pad(masks[c], BORDER, "reflect"), mirrored(greens)
        tentative = guided(guide, known, mask, RADIUS)
        left = np.where(mask, known - tentative, 0)
        planes[c] = raw.copy()
        for y, x in np.ndindex(height, width):
            if not masks[c, y, x]:
                near = left[y + BORDER - 1 : y + BORDER + 2, x + BORDER - 1 : x + BORDER + 2]
                planes[c][y, x] = (
                    tentative[y + BORDER, x + BORDER] + (near * np.outer([0.5, 1, 0.5], [0.5, 1, 0.5])).sum()
                )
    return np.stack(planes)


@pytest.mark.parametrize(("pattern", "size"), [("RGGB", (3, 4)), ("GBRG", (7, 6)), ("BGGR", (5, 4))])
def test_pictures_equal_those_of_loops(pattern, size):
    raw = torch.rand(size, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = torch.from_numpy(residual_interpolation(raw.numpy(), pattern))
    torch.testing.assert_close(demosaic_residual(raw, pattern), expected, rtol=0, atol=1e-10)


def test_better_than_linear_filters_on_a_photograph():
    from skimage import data

    rgb = torch.tensor(data.astronaut()[:192, 128:320]).movedim(-1, 0).double() / 255
    raw = mosaic(rgb)
    # where a guide is nearly flat, lines are steep, and float32 shows
    torch.testing.assert_close(demosaic_residual(raw.float()).double(), demosaic_residual(raw), rtol=0, atol=1e-4)
    assert psnr(demosaic_residual(raw), rgb) > psnr(demosaic(raw), rgb) + 0.5
