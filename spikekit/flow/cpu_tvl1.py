"""One level of :func:`spikekit.flow.tvl1.tvl1_flow` on a CPU, compiled by Numba."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from spikekit.flow.tvl1 import COUPLING, ROUNDS, SMOOTHINGS, STEP
from spikekit.kernels.compiled import compiled, in_threads


@compiled
def _warp(image, time, flow, out):
    """Warp an image by ``time`` times the flow, bilinearly, with replicated borders."""
    height, width = image.shape
    zero, one = image.dtype.type(0), image.dtype.type(1)
    for y in range(height):
        for x in range(width):
            at_x, at_y = x + time * flow[0, y, x], y + time * flow[1, y, x]
            at_x = min(at_x, width - one) if at_x > 0 else zero  # also for NaN
            at_y = min(at_y, height - one) if at_y > 0 else zero
            left, top = min(int(at_x), width - 2), min(int(at_y), height - 2)
            right_share, low_share = image.dtype.type(at_x - left), image.dtype.type(at_y - top)
            upper = image[top, left] + right_share * (image[top, left + 1] - image[top, left])
            lower = image[top + 1, left] + right_share * (image[top + 1, left + 1] - image[top + 1, left])
            out[y, x] = upper + low_share * (lower - upper)


@compiled
def _linearise(moved, times, flow, slope, rest):
    """Linearise the difference of two warped pictures in the flow: slope, and value at zero flow."""
    height, width = rest.shape
    for y in range(height):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            along_x = times[1] * (moved[1, y, right] - moved[1, y, left])
            along_x -= times[0] * (moved[0, y, right] - moved[0, y, left])
            along_y = times[1] * (moved[1, below, x] - moved[1, above, x])
            along_y -= times[0] * (moved[0, below, x] - moved[0, above, x])
            slope[0, y, x], slope[1, y, x] = along_x / (right - left), along_y / (below - above)
            rest[y, x] = moved[1, y, x] - moved[0, y, x]
            rest[y, x] -= slope[0, y, x] * flow[0, y, x] + slope[1, y, x] * flow[1, y, x]


@compiled
def _follow(flow, slope, rest, limit, near):
    """Data step: move the flow along the slope until the pictures agree, at most by the limit."""
    height, width = rest.shape
    tiny = rest.dtype.type(1e-30)
    for y in range(height):
        for x in range(width):
            along_x, along_y = slope[0, y, x], slope[1, y, x]
            differs = rest[y, x] + along_x * flow[0, y, x] + along_y * flow[1, y, x]
            way = -differs / (along_x * along_x + along_y * along_y + tiny)
            way = min(max(way, -limit[y, x]), limit[y, x])
            near[0, y, x], near[1, y, x] = flow[0, y, x] + way * along_x, flow[1, y, x] + way * along_y


@compiled
def _primal(near, dual, flow, y):
    """Compute a row of the flow from the dual variable, ``dual[k, y + 1, x + 1]`` at pixel (x, y), padded by zeros."""
    for x in range(flow.shape[1]):
        to_x = dual[0, y + 1, x + 1] - dual[0, y + 1, x]
        flow[y, x] = near[y, x] + to_x + dual[1, y + 1, x + 1] - dual[1, y, x + 1]


@compiled
def _smooth(near, dual, flow, step, damping):
    """Take one step of total-variation denoising of ``near``, in one pass; the dual follows one row behind."""
    height, width = flow.shape
    zero, one = near.dtype.type(0), near.dtype.type(1)
    _primal(near, dual, flow, 0)
    for y in range(height):
        below = min(y + 1, height - 1)
        if below > y:
            _primal(near, dual, flow, below)
        for x in range(width):
            to_right = flow[y, x + 1] - flow[y, x] if x + 1 < width else zero
            down = flow[below, x] - flow[y, x]
            share = one / (one + damping * np.sqrt(to_right * to_right + down * down))
            dual[0, y + 1, x + 1] = (dual[0, y + 1, x + 1] + step * to_right) * share
            dual[1, y + 1, x + 1] = (dual[1, y + 1, x + 1] + step * down) * share


@compiled
def _level(pictures, times, limit, flow, warps, step, damping):
    """Improve the flow (2, H, W) of two pictures (2, H, W) in place."""
    moved, slope, near = np.empty_like(flow), np.empty_like(flow), np.empty_like(flow)
    rest, dual = np.empty_like(flow[0]), np.zeros((2, 2, flow.shape[1] + 1, flow.shape[2] + 1), flow.dtype)
    for _ in range(warps):
        for k in range(2):
            _warp(pictures[k], times[k], flow, moved[k])
        _linearise(moved, times, flow, slope, rest)
        for _ in range(ROUNDS):
            _follow(flow, slope, rest, limit, near)
            for axis in range(2):
                for _ in range(SMOOTHINGS):
                    _smooth(near[axis], dual[axis], flow[axis], step, damping)
                for y in range(flow.shape[1]):
                    _primal(near[axis], dual[axis], flow[axis], y)


def refine(pictures: Tensor, times: Tensor, limit: Tensor, flow: Tensor, warps: int) -> Tensor:
    """Return the flow (B, 2, H, W) of pictures (B, 2, H, W), like :func:`spikekit.flow.tvl1.refine`."""
    flow = flow.contiguous().clone()
    arrays = (part.contiguous().numpy() for part in (pictures, times.to(pictures), limit, flow))
    real = pictures.numpy().dtype.type
    in_threads(_level, ((*own, warps, real(STEP), real(STEP / COUPLING)) for own in zip(*arrays, strict=True)))
    return flow
