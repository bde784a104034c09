"""Site-wise search on a CPU, see :mod:`spikekit.warp.site_search`, compiled by Numba."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from spikekit.kernels.compiled import compiled, in_threads
from spikekit.kernels.layout import new_tensor

_ROWS = 16  # sensor rows per job


def _on_axis(moved: Any, at: Any, length: Any, low: Any, high: Any, steps: Any) -> Any:
    """Return base, place and fraction of a moved site on an axis, see :meth:`SiteTable.classes`."""
    moved = min(max(moved, np.float32(-2 * length)), np.float32(2 * length))
    to = min(max(np.int64(np.rint(moved * np.float32(steps))) + at * steps, -steps), length * steps)
    base = to // steps
    place = base & 1
    if base < -low:
        place = base + 3
    if base + high >= length:
        place = 3 - low + length - base
    return base, place, to - base * steps


_place = compiled(_on_axis)


def _find(flow: Any, shares: Any, t: Any, y: Any, x: Any, low: Any, high: Any, steps: Any) -> Any:
    """Return row and column of the base of a site at a time point, and its class."""
    height, width = flow.shape[2:]
    a, b = shares[t, 0], shares[t, 1]
    row, i, down = _place(a * flow[0, 1, y, x] + b * flow[1, 1, y, x], y, height, low, high, steps)
    column, j, right = _place(a * flow[0, 0, y, x] + b * flow[1, 0, y, x], x, width, low, high, steps)
    if i < 2 and j < 2:
        return row, column, ((2 * i + j) * steps + down) * steps + right
    coarse = steps // 2
    border = ((i * (4 - low + high) + j) * coarse + down // 2) * coarse + right // 2
    return row, column, 4 * steps * steps + border


_class = compiled(_find)


def _search(
    features: Any, flow: Any, shares: Any, start: Any, jump: Any, weight: Any, low: Any, high: Any, steps: Any,
    rows: Any, out: Any, half: Any,
) -> None:  # fmt: skip
    """Compute the temporal pixels of some rows: features (T, H, W, F), flow (2, 2, H, W), out (H, W, T, F, s^2)."""
    times, height, width, channels = features.shape
    pixels = weight.shape[1]
    flat = features.reshape(times, height * width * channels)
    total = np.empty((channels, pixels), np.float32)
    bits = total.view(np.uint32)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            for t in range(times):
                row, column, which = _class(flow, shares, t, y, x, low, high, steps)
                at = (row * width + column) * channels
                k, last = start[which], start[which + 1]
                total[:] = 0
                if pixels == 1:
                    while k < last:
                        for c in range(channels):
                            total[c, 0] += weight[k, 0] * flat[t, at + jump[k] + c]
                        k += 1
                while k + 4 <= last:  # four at a time, to keep the sums in registers
                    for c in range(channels):
                        p, q = flat[t, at + jump[k] + c], flat[t, at + jump[k + 1] + c]
                        r, s = flat[t, at + jump[k + 2] + c], flat[t, at + jump[k + 3] + c]
                        for n in range(pixels):
                            more = weight[k, n] * p + weight[k + 1, n] * q
                            total[c, n] += more + (weight[k + 2, n] * r + weight[k + 3, n] * s)
                    k += 4
                while k < last:
                    for c in range(channels):
                        p = flat[t, at + jump[k] + c]
                        for n in range(pixels):
                            total[c, n] += weight[k, n] * p
                    k += 1
                for c in range(channels):
                    for n in range(pixels):
                        if half:  # bfloat16 is the upper half of a float32, rounded to even
                            word = bits[c, n]
                            out[y, x, t, c, n] = (word + np.uint32(0x7FFF) + ((word >> 16) & np.uint32(1))) >> 16
                        else:
                            out[y, x, t, c, n] = total[c, n]


_search_rows = compiled(_search)


def _spread(
    grad: Any, flow: Any, shares: Any, start: Any, jump: Any, weight: Any, low: Any, high: Any, steps: Any,
    t: Any, out: Any,
) -> None:  # fmt: skip
    """Add the gradient of the features of a time point to zeros ``out`` (T, H, W, F), from grad (H, W, T, F, s^2)."""
    _, height, width, channels = out.shape
    pixels = weight.shape[1]
    flat = out.reshape(len(out), height * width * channels)
    for y in range(height):
        for x in range(width):
            row, column, which = _class(flow, shares, t, y, x, low, high, steps)
            at = (row * width + column) * channels
            for k in range(start[which], start[which + 1]):
                for c in range(channels):
                    total = np.float32(0)
                    for n in range(pixels):
                        total += weight[k, n] * grad[y, x, t, c, n]
                    flat[t, at + jump[k] + c] += total


_spread_time = compiled(_spread)


def search_sites(
    features: Tensor, flow: Tensor, shares: Tensor, start: Tensor, offset: Tensor, weight: Tensor,
    scale: int, low: int, high: int, most: int, steps: int,
) -> Tensor:  # fmt: skip
    """Map (B, T, F, H, W) to (B, T F s^2, H, W), float32 or bfloat16."""
    batch, times, channels, height, width = features.shape
    half = features.dtype is torch.bfloat16
    out = new_tensor((batch, height, width, times, channels, scale**2), features.dtype)
    rows = features.permute(0, 1, 3, 4, 2).float().contiguous()
    jump = (offset[:, 0] * width + offset[:, 1]) * channels
    table = [part.numpy() for part in (shares.float(), start, jump, weight)]
    for features_b, flow_b, out_b in zip(rows.numpy(), flow.contiguous().numpy(), out, strict=True):
        result = (out_b.view(torch.uint16) if half else out_b).numpy()
        jobs = ((y, min(y + _ROWS, height)) for y in range(0, height, _ROWS))
        arguments = features_b, flow_b, *table, low, high, steps
        in_threads(_search_rows, ((*arguments, job, result, half) for job in jobs))
    return out.flatten(3).movedim(-1, 1)


def spread_sites(
    grad: Tensor, flow: Tensor, shares: Tensor, start: Tensor, offset: Tensor, weight: Tensor,
    scale: int, low: int, high: int, most: int, steps: int,
) -> Tensor:  # fmt: skip
    """Return its derivative in the features, (B, T F s^2, H, W) to (B, T, F, H, W), float32."""
    times = len(shares)
    rows = grad.movedim(1, -1).float().contiguous().unflatten(-1, (times, -1, scale**2))
    batch, height, width, _, channels, _ = rows.shape
    out = new_tensor((batch, times, height, width, channels), torch.float32, np.zeros)
    jump = (offset[:, 0] * width + offset[:, 1]) * channels
    table = [part.numpy() for part in (shares.float(), start, jump, weight)]
    for rows_b, flow_b, out_b in zip(rows.numpy(), flow.contiguous().numpy(), out.numpy(), strict=True):
        arguments = rows_b, flow_b, *table, low, high, steps
        in_threads(_spread_time, ((*arguments, t, out_b) for t in range(times)))
    return out.permute(0, 1, 4, 2, 3)
