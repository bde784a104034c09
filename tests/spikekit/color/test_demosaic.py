"""Demosaicing against the formulas of Malvar, He and Cutler, pixel by pixel."""

import numpy as np
import pytest
import torch

from spikekit import demosaic, demosaic_residual, mosaic

PATTERNS = ["RGGB", "BGGR", "GRBG", "GBRG"]


def malvar(raw, pattern):
    height, width = raw.shape

    def at(y, x):
        y, x = abs(y), abs(x)
        return raw[min(y, 2 * (height - 1) - y), min(x, 2 * (width - 1) - x)]

    def color(y, x):
        return pattern[2 * (y % 2) + x % 2]

    rgb = np.zeros((3, height, width))
    for y, x in np.ndindex(height, width):
        here = at(y, x)
        near_x, near_y = at(y, x - 1) + at(y, x + 1), at(y - 1, x) + at(y + 1, x)
        far_x, far_y = at(y, x - 2) + at(y, x + 2), at(y - 2, x) + at(y + 2, x)
        diagonal = at(y - 1, x - 1) + at(y - 1, x + 1) + at(y + 1, x - 1) + at(y + 1, x + 1)
        for c, wanted in enumerate("RGB"):
            if color(y, x) == wanted:  # known
                value = here
            elif wanted == "G":  # equal gain for the Laplacian of red or blue: 1/2
                value = (near_x + near_y) / 4 + (here - (far_x + far_y) / 4) / 2
            elif color(y, x + 1) == wanted:  # the wanted colour is left and right, gain 5/8
                value = near_x / 2 + (5 * here - far_x - diagonal + far_y / 2) / 8
            elif color(y + 1, x) == wanted:
                value = near_y / 2 + (5 * here - far_y - diagonal + far_x / 2) / 8
            else:  # red at blue or blue at red, gain 3/4
                value = diagonal / 4 + 3 / 4 * (here - (far_x + far_y) / 4)
            rgb[c, y, x] = value
    return rgb


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", [(3, 3), (5, 8), (6, 7)])
def test_pictures_equal_those_of_the_published_filters(pattern, size):
    raw = torch.randint(-64, 65, size).double()  # whole numbers in, sixteenths out: exact
    expected = torch.from_numpy(malvar(raw.numpy(), pattern))
    for dtype in (torch.float64, torch.float32):
        rgb = demosaic(raw.to(dtype), pattern)
        assert rgb.dtype == dtype
        assert torch.equal(rgb.double(), expected)
    for dtype in (torch.bfloat16, torch.float16):
        assert torch.equal(demosaic(raw.to(dtype), pattern), expected.to(dtype))


BOTH = pytest.mark.parametrize("method", [demosaic, demosaic_residual])


@BOTH
@pytest.mark.parametrize("pattern", PATTERNS)
def test_known_values_are_kept(method, pattern):
    raw = torch.rand(2, 3, 6, 5)
    rgb = method(raw, pattern)
    assert rgb.shape == (2, 3, 3, 6, 5)
    assert torch.equal(mosaic(rgb, pattern), raw)


@BOTH
@pytest.mark.parametrize("size", [(2, 5), (5, 2)])
def test_mosaics_that_are_too_small(method, size):
    with pytest.raises(ValueError, match="at least 3 x 3"):
        method(torch.rand(size))
