"""The deformable convolution of the baselines, against loops in float64."""

import itertools
import math

import pytest
import torch
import torch.nn.functional as F

from lightning_modules.networks.baselines.deformable import DeformableConv2d


def at(plane, y, x):
    """Bilinear, zero outside."""
    total = 0.0
    for row, column in itertools.product((math.floor(y), math.floor(y) + 1), (math.floor(x), math.floor(x) + 1)):
        if 0 <= row < plane.shape[0] and 0 <= column < plane.shape[1]:
            total += plane[row, column].item() * (1 - abs(y - row)) * (1 - abs(x - column))
    return total


def brute_force(part, features, guide, groups):
    where = part.where(guide)[0]
    channels, height, width = features.shape[1:]
    offsets = where[: 18 * groups].unflatten(0, (groups, 9, 2))
    masks = where[18 * groups :].unflatten(0, (groups, 9)).sigmoid()
    result = part.bias[:, None, None].repeat(1, height, width)
    for c, y, x, tap in itertools.product(range(channels), range(height), range(width), range(9)):
        g = c // (channels // groups)
        dy, dx = (offsets[g, tap, axis, y, x].item() for axis in (0, 1))
        value = at(features[0, c], y + tap // 3 - 1 + dy, x + tap % 3 - 1 + dx)
        result[:, y, x] += part.weight[:, c, tap // 3, tap % 3] * value * masks[g, tap, y, x]
    return result


def test_taps_look_where_features_say():
    torch.manual_seed(0)
    part = DeformableConv2d(4, groups=2).double()
    torch.nn.init.normal_(part.where.weight, std=0.3)
    torch.nn.init.normal_(part.where.bias)
    features, guide = torch.randn(2, 1, 4, 4, 5, dtype=torch.float64)
    torch.testing.assert_close(part(features, guide)[0], brute_force(part, features, guide, 2))


def test_begins_as_a_convolution_at_half_weight():
    torch.manual_seed(0)
    part = DeformableConv2d(16)
    features, guide = torch.randn(2, 2, 16, 6, 7)
    torch.testing.assert_close(part(features, guide), F.conv2d(features, part.weight / 2, part.bias, padding=1))


def test_positions_are_exact_under_autocast():
    """In bfloat16 whole numbers above 256 would be rounded."""
    torch.manual_seed(0)
    part = DeformableConv2d(8)
    features = torch.randn(1, 8, 3, 600)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        got = part(features, features)
    torch.testing.assert_close(got, part(features, features))


def test_channels_in_groups():
    with pytest.raises(
        ValueError, match="width: expected a multiple of 8, the groups of a deformable convolution, got 12"
    ):
        DeformableConv2d(12)
