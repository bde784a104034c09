"""Site-wise search on a GPU, see :mod:`spikekit.warp.site_search`: a gather forwards, atomic sums backwards."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from spikekit.kernels.gpu_parts import launch, store

_BLOCK = 32  # sites per program


@triton.jit
def _on_axis(moved, at, length, low, high, steps):
    """Return base, place and fraction of moved sites on an axis, see ``SiteTable.classes``."""
    far = (2 * length).to(tl.float32)
    moved = tl.minimum(tl.maximum(moved, -far), far) * steps
    # round half to even by adding 1.5 * 2^23; far is well below 2^22 / steps
    whole = tl.where(tl.abs(moved) < 4194304.0, (moved + 12582912.0) - 12582912.0, moved).to(tl.int32)
    to = tl.minimum(tl.maximum(whole + at * steps, -steps), length * steps)
    base = (to + steps) // steps - 1  # keeps the dividend non-negative
    place = tl.where(base < -low, base + 3, base & 1)
    place = tl.where(base + high >= length, 3 - low + length - base, place)
    return base, place, to - base * steps


@triton.jit
def _classify(flow, shares, start, batch, time, y, x, inside, height, width, low, high, steps):
    """Return rows and columns of the bases of sites, and the range of their features in the table."""
    plane = height * width
    at = batch.to(tl.int64) * 4 * plane + y * width + x
    a = tl.load(shares + 2 * time)
    b = tl.load(shares + 2 * time + 1)
    moved_x = a * tl.load(flow + at, mask=inside, other=0.0)
    moved_x += b * tl.load(flow + at + 2 * plane, mask=inside, other=0.0)
    moved_y = a * tl.load(flow + at + plane, mask=inside, other=0.0)
    moved_y += b * tl.load(flow + at + 3 * plane, mask=inside, other=0.0)
    row, i, down = _on_axis(moved_y, y, height, low, high, steps)
    column, j, right = _on_axis(moved_x, x, width, low, high, steps)
    coarse = steps // 2
    border = 4 * steps * steps + ((i * (4 - low + high) + j) * coarse + down // 2) * coarse + right // 2
    which = tl.where((i < 2) & (j < 2), ((2 * i + j) * steps + down) * steps + right, border)
    begin = tl.load(start + which, mask=inside, other=0)
    end = tl.load(start + which + 1, mask=inside, other=0)
    return row, column, begin, end


@triton.jit(do_not_specialize=["times", "height", "width"])
def _gather_kernel(
    features, flow, shares, start, offset, weight, out, times, height, width, low, high, steps,
    channels: tl.constexpr, pixels: tl.constexpr, channels_up: tl.constexpr, pixels_up: tl.constexpr,
    block: tl.constexpr, back: tl.constexpr,
):  # fmt: skip
    """Map features (B, T, H, W, F) to ``out`` (B, H, W, T, F, s^2), or, with ``back``, its adjoint back to features."""
    plane = height * width
    blocks = tl.cdiv(plane, block)
    program = tl.program_id(0)
    site = (program % blocks) * block + tl.arange(0, block)
    time = (program // blocks) % times
    batch = program // (blocks * times)
    inside = site < plane
    y, x = site // width, site % width
    row, column, begin, end = _classify(flow, shares, start, batch, time, y, x, inside, height, width, low, high, steps)
    channel, pixel = tl.arange(0, channels_up), tl.arange(0, pixels_up)
    place = ((batch.to(tl.int64) * plane + site) * times + time) * (channels * pixels)
    places = place[:, None, None] + (channel[:, None] * pixels + pixel[None, :])[None, :, :]
    there = ((channel < channels)[:, None] & (pixel < pixels)[None, :])[None, :, :] & inside[:, None, None]
    source = (batch.to(tl.int64) * times + time) * plane
    if back:
        total = tl.load(out + places, mask=there, other=0.0).to(tl.float32)
    else:
        total = tl.zeros((block, channels_up, pixels_up), tl.float32)
    most = tl.max(end - begin, axis=0)
    for k in range(0, most):
        tap = begin + k
        known = tap < end
        down = tl.load(offset + 2 * tap, mask=known, other=0)
        right = tl.load(offset + 2 * tap + 1, mask=known, other=0)
        at = (source + (row + down) * width + column + right) * channels
        values = at[:, None] + channel[None, :]
        some = known[:, None] & (channel < channels)[None, :]
        by = tl.load(
            weight + tap[:, None] * pixels + pixel[None, :], mask=known[:, None] & (pixel < pixels)[None, :], other=0.0
        )
        if back:
            tl.atomic_add(features + values, tl.sum(total * by[:, None, :], axis=2), mask=some, sem="relaxed")
        else:
            value = tl.load(features + values, mask=some, other=0.0).to(tl.float32)
            total += value[:, :, None] * by[:, None, :]
    if not back:
        store(out + places, total, there)


def _launch(features: Tensor, flow: Tensor, table: list[Tensor], out: Tensor, sizes: list[int], back: bool) -> None:
    batch, times, height, width, channels = features.shape
    pixels = out.shape[-1]
    programs = triton.cdiv(height * width, _BLOCK) * times * batch
    launch(
        _gather_kernel, programs, features, flow.contiguous(), *table, out, times, height, width, *sizes,
        channels=channels, pixels=pixels, channels_up=triton.next_power_of_2(channels),
        pixels_up=triton.next_power_of_2(pixels), block=_BLOCK, back=back,
    )  # fmt: skip


def search_sites(
    features: Tensor, flow: Tensor, shares: Tensor, start: Tensor, offset: Tensor, weight: Tensor,
    scale: int, low: int, high: int, most: int, steps: int,
) -> Tensor:  # fmt: skip
    """Map (B, T, F, H, W) to (B, T F s^2, H, W), any floating dtype but float64."""
    batch, times, channels, height, width = features.shape
    out = features.new_empty(batch, height, width, times, channels, scale**2)
    rows = features.permute(0, 1, 3, 4, 2).contiguous()
    _launch(rows, flow, [shares, start, offset, weight], out, [low, high, steps], back=False)
    return out.flatten(3).movedim(-1, 1)


def spread_sites(
    grad: Tensor, flow: Tensor, shares: Tensor, start: Tensor, offset: Tensor, weight: Tensor,
    scale: int, low: int, high: int, most: int, steps: int,
) -> Tensor:  # fmt: skip
    """Return its derivative in the features, (B, T F s^2, H, W) to (B, T, F, H, W), float32."""
    times, pixels = len(shares), scale**2
    rows = grad.movedim(1, -1).contiguous().unflatten(-1, (times, -1, pixels))
    batch, height, width, _, channels, _ = rows.shape
    out = torch.zeros(batch, times, height, width, channels, device=grad.device)
    _launch(out, flow, [shares, start, offset, weight], rows, [low, high, steps], back=True)
    return out.permute(0, 1, 4, 2, 3)
