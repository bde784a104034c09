"""Brute-force references of the operators: loops in exact arithmetic, or in float64 where roots are taken.

Nothing here is shared with the operators. Inputs are what the operator got, after rounding to its dtype.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

import numpy as np


def integrate_fire(light: Sequence[float], threshold: float, start: float = 0.0) -> tuple[list[bool], Fraction]:
    """Spikes of one pixel and the charge left, for finite light."""
    theta, charge = Fraction(threshold), Fraction(start)
    spikes = []
    for light_t in light:
        charge += Fraction(light_t)
        spikes.append(charge >= theta)
        if charge >= theta:
            charge %= theta
    return spikes, charge


def straight_through(light: float, threshold: float) -> Fraction:
    """Gradient of a spike with respect to its light."""
    return 1 / Fraction(threshold) if 0 <= light <= threshold else Fraction(0)  # NaN is on neither side


def spike_interval(fired: Sequence[bool]) -> list[int]:
    """Distance between the spikes around every frame of one pixel."""
    frames, times = len(fired), [k for k, spike in enumerate(fired) if spike]
    gaps = [after - before for before, after in pairwise(times)]
    result = []
    for n in range(frames):
        earlier, later = [k for k in times if k < n], [k for k in times if k >= n]
        waited = (later[0] if later else frames) - (earlier[-1] if earlier else -1)
        if gaps and not earlier:
            waited = max(waited, gaps[0])
        if gaps and not later:
            waited = max(waited, gaps[-1])
        result.append(waited)
    return result


def tfi(fired: Sequence[bool], max_range: float) -> list[Fraction]:
    """Inverse of the interval at every frame of one pixel."""
    return [Fraction(max_range) / gap for gap in spike_interval(fired)]


def tfi_gradient(fired: Sequence[bool], weight: Sequence[float], max_range: float) -> list[Fraction]:
    """Gradient of sum(weight * tfi) with respect to every spike of one pixel."""
    frames, times = len(fired), [k for k, spike in enumerate(fired) if spike]
    total = [Fraction(0)] * frames
    for n, gap in enumerate(spike_interval(fired)):
        begin = max([k + 1 for k in times if k < n], default=0)
        end = min([k + 1 for k in times if k >= n], default=frames)
        for k in range(begin, end):
            total[k] += Fraction(weight[n]) * Fraction(max_range) / gap
    return total


def tfp(stream: Sequence[float], max_range: float, window: int) -> list[Fraction]:
    """Mean of one pixel over the frames of the window that exist."""
    half, result = window // 2, []
    for n in range(len(stream)):
        inside = stream[max(n - half, 0) : n + half + 1]
        result.append(Fraction(max_range) * sum(map(Fraction, inside)) / len(inside))
    return result


def tfp_gradient(_: Sequence[bool], weight: Sequence[float], max_range: float, window: int) -> list[Fraction]:
    """Gradient of sum(weight * tfp) with respect to every frame of one pixel."""
    frames, half = len(weight), window // 2
    total = [Fraction(0)] * frames
    for n in range(frames):
        inside = range(max(n - half, 0), min(n + half + 1, frames))
        for k in inside:
            total[k] += Fraction(weight[n]) * Fraction(max_range) / len(inside)
    return total


def idw(
    features: np.ndarray, flow: np.ndarray, mask: np.ndarray, neighbors: int = 4, columns: Sequence[int] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse-distance-weighted mean of the nearest known pixels; distances are compared as whole numbers.

    Args:
        features: (C, H, W).
        flow: (2, H, W), finite.
        mask: (H, W).
        neighbors: how many.
        columns: of the result; all when not given.

    Returns:
        The result (C, H, columns); its derivative by the flow (C, 2, H, columns), 0 on a known pixel; and the largest
        magnitude among the neighbours (C, H, columns), which rounding errors are in proportion to.
    """
    channels, height, width = features.shape
    columns = range(width) if columns is None else columns
    known = [(int(y), int(x)) for y, x in np.argwhere(mask)]  # row-major
    shape = (channels, height, len(columns))
    result, largest, slope = np.zeros(shape), np.zeros(shape), np.zeros((channels, 2, height, len(columns)))
    for y in range(height):
        for j, x in enumerate(columns):
            at_x, at_y = x + Fraction(float(flow[0, y, x])), y + Fraction(float(flow[1, y, x]))
            unit = max(at_x.denominator, at_y.denominator)  # powers of two
            at_x, at_y = int(at_x * unit), int(at_y * unit)
            offsets = [(column * unit - at_x, row * unit - at_y) for row, column in known]
            nearest = sorted(range(len(known)), key=lambda i: offsets[i][0] ** 2 + offsets[i][1] ** 2)[:neighbors]
            square = [offsets[i][0] ** 2 + offsets[i][1] ** 2 for i in nearest]
            if square[0] == 0:
                nearest, square = nearest[:1], [1]
                direction = np.zeros((1, 2))
            else:
                direction = np.array([[d * unit / s for d in offsets[i]] for i, s in zip(nearest, square, strict=True)])
            weight = np.array([math.sqrt(square[0] / s) for s in square])
            share = weight / weight.sum()
            values = np.stack([features[:, known[i][0], known[i][1]] for i in nearest], axis=-1)
            result[:, y, j] = values[:, 0] + (values - values[:, :1]) @ share
            difference = (values[:, :, None] - values[:, None, :]) @ share  # from the mean, without cancellation
            slope[:, :, y, j] = difference * share @ direction
            largest[:, y, j] = np.abs(values).max(axis=-1)
    return result, slope, largest


def bilinear(image: np.ndarray, flow: np.ndarray, columns: Sequence[int] | None = None) -> np.ndarray:
    """Bilinear interpolation of (C, H, W), positions moved to the border."""
    height, width = image.shape[1:]
    columns = range(width) if columns is None else columns
    result = np.zeros((len(image), height, len(columns)))
    for y in range(height):
        for j, x in enumerate(columns):
            at_x, at_y = np.clip(x + flow[0, y, x], 0, width - 1), np.clip(y + flow[1, y, x], 0, height - 1)
            left, top = int(at_x), int(at_y)
            right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
            upper = image[:, top, left] + (image[:, top, right] - image[:, top, left]) * (at_x - left)
            lower = image[:, bottom, left] + (image[:, bottom, right] - image[:, bottom, left]) * (at_x - left)
            result[:, y, j] = upper + (lower - upper) * (at_y - top)
    return result
