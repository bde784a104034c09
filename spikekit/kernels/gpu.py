"""Fused Triton kernels of the sensor and the decoders on a GPU (CUDA or ROCm); also exports the other GPU kernels.

Every public function takes the arguments of the custom operator of the same name and returns the result of its torch
path, in the memory layout of ``torch.empty_like``, or ``NotImplemented`` if the torch path must run.

Streams are (B, T, P): batch, time, pixel. A program loops over time for a block of pixels of one stream. A second sweep
is a separate kernel, so that threads do not depend on each other's stores. Division is rounded as in IEEE 754, and
products are not fused with sums, as Triton's defaults would move spikes.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from spikekit.check import wide_dtype
from spikekit.kernels.gpu_parts import launch, my_pixels, store
from spikekit.kernels.gpu_sites import search_sites, spread_sites  # noqa: F401
from spikekit.kernels.gpu_tvl1 import tvl1_level  # noqa: F401
from spikekit.kernels.gpu_warp import nearest_known, weighted_dot, weighted_gather, weighted_scatter  # noqa: F401

_BLOCK = 512  # pixels per program: four per thread, so that a thread reads at least four bytes at a time
_STAGES = tl.constexpr(4)  # frames that are prefetched
_LONGEST = 32766  # largest number of frames whose intervals, up to one more, fit into int16


def _bytes(tensor: Tensor) -> Tensor:
    """View a bool tensor as bytes; Triton would read single bits."""
    return tensor.view(torch.uint8) if tensor.dtype is torch.bool else tensor


def _flat(stream: Tensor) -> Tensor:
    """Reshape (*, T, H, W) to (B, T, P), as a view if possible."""
    return _bytes(stream.detach()).reshape(stream.shape[:-3].numel(), stream.shape[-3], stream.shape[-2:].numel())


def _scalar(value: float, like: Tensor, dtype: torch.dtype) -> Tensor:
    """Return a number as a tensor; Triton would round an argument to float32."""
    return torch.full((), value, dtype=dtype, device=like.device)


def _as(layout: Tensor, result: Tensor) -> Tensor:
    """Return the contiguous ``result`` in the shape and memory layout of ``torch.empty_like(layout)``."""
    if torch.empty_like(layout, device="meta").is_contiguous():
        return result.reshape(layout.shape)
    return torch.empty_like(layout, dtype=result.dtype).copy_(result.reshape(layout.shape))


def _blocks(stream: Tensor) -> int:
    return stream.shape[0] * triton.cdiv(stream.shape[2], _BLOCK)


@triton.jit
def _divide(a, b):
    """Divide as in IEEE 754; plain division is approximate in float32."""
    if a.dtype == tl.float64:
        return a / b
    else:  # noqa: RET505 - Triton compiles only the branch that is taken
        return tl.div_rn(a, b)


@triton.jit(do_not_specialize=["frames"])
def _integrate_fire_kernel(
    light, threshold, charge, spikes, left, frames, pixels, light_b, light_t, light_p, block: tl.constexpr
):
    """Integrate the light of a block of pixels clock by clock: one read of the light, one write of the spikes."""
    b, pixel, inside = my_pixels(pixels, block)
    light += b * light_b + pixel * light_p
    light_t = tl.cast(light_t, tl.int64)
    pixels = tl.cast(pixels, tl.int64)
    spikes += b * frames * pixels + pixel
    theta = tl.load(threshold)
    rest = tl.load(charge + b * pixels + pixel, mask=inside, other=0)
    for t in tl.range(frames, num_stages=_STAGES):
        full = rest + tl.load(light + t * light_t, mask=inside, other=0).to(theta.dtype)
        fired = full >= theta
        if spikes.dtype.element_ty == tl.uint8:
            tl.store(spikes + t * pixels, fired.to(tl.uint8), mask=inside)
        else:
            store(spikes + t * pixels, fired.to(theta.dtype), inside)
        rest = tl.where(fired, full - theta, full)
        remainder = full - tl.floor(_divide(full, theta)) * theta
        remainder = tl.where((remainder >= 0) & (remainder < theta), remainder, 0)
        rest = tl.where(rest >= theta, remainder, rest)
    tl.store(left + b * pixels + pixel, rest, mask=inside)


def integrate_fire(light: Tensor, threshold: float, charge: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Read the light once and write the spikes once."""
    flat, start = _flat(light), charge.detach().contiguous()
    spikes, left = flat.new_empty(flat.shape, dtype=dtype), torch.empty_like(start)
    theta = _scalar(threshold, light, charge.dtype)
    sizes = *flat.shape[1:], *flat.stride()
    launch(_integrate_fire_kernel, _blocks(flat), flat, theta, start, _bytes(spikes), left, *sizes, block=_BLOCK)
    return _as(light, spikes), _as(charge, left)


@triton.jit(do_not_specialize=["frames"])
def _next_spike_kernel(spikes, following, first, frames, pixels, spikes_b, spikes_t, spikes_p, block: tl.constexpr):
    """Find the next spike of every frame, T if there is none, and the first complete interval of every pixel.

    Backwards in time: one read of the spikes, one write.
    """
    b, pixel, inside = my_pixels(pixels, block)
    spikes += b * spikes_b + pixel * spikes_p
    spikes_t = tl.cast(spikes_t, tl.int64)
    pixels = tl.cast(pixels, tl.int64)
    following += b * frames * pixels + pixel
    after = tl.zeros([block], tl.int32) + frames
    complete = tl.zeros([block], tl.int32)
    for i in tl.range(frames, num_stages=_STAGES):
        n = frames - 1 - i
        fired = tl.load(spikes + n * spikes_t, mask=inside, other=0) != 0
        complete = tl.where(fired & (after < frames), after - n, complete)
        after = tl.where(fired, n, after)
        tl.store(following + n * pixels, after.to(following.dtype.element_ty), mask=inside)
    tl.store(first + b * pixels + pixel, complete, mask=inside)


@triton.jit(do_not_specialize=["frames"])
def _interval_kernel(following, first, result, max_range, frames, pixels, as_light: tl.constexpr, block: tl.constexpr):
    """Compute intervals, or max_range / interval if ``as_light``; the result may overwrite ``following``.

    Forwards in time: one read of the next spikes, one write.
    """
    b, pixel, inside = my_pixels(pixels, block)
    pixels = tl.cast(pixels, tl.int64)
    following += b * frames * pixels + pixel
    result += b * frames * pixels + pixel
    white = tl.load(max_range)
    first_complete = tl.load(first + b * pixels + pixel, mask=inside, other=0)
    last_complete = tl.zeros([block], tl.int32)
    before = tl.zeros([block], tl.int32) - 1  # the last spike, -1 if there is none
    for n in tl.range(frames, num_stages=_STAGES):
        after = tl.load(following + n * pixels, mask=inside, other=0).to(tl.int32)
        fired = after == n
        complete = tl.where(before < 0, first_complete, tl.where(after < frames, 0, last_complete))
        interval = tl.maximum(after - before, complete)
        last_complete = tl.where(fired & (before >= 0), n - before, last_complete)
        before = tl.where(fired, n, before)
        if as_light:
            interval = tl.maximum(interval, 1).to(white.dtype)  # 0 outside the picture
            store(result + n * pixels, _divide(white, interval), inside)
        else:
            tl.store(result + n * pixels, interval.to(result.dtype.element_ty), mask=inside)


def _intervals(spikes: Tensor, max_range: float = 1.0, dtype: torch.dtype | None = None) -> Tensor:
    flat = _flat(spikes)
    batch, frames, pixels = flat.shape
    following = flat.new_empty(flat.shape, dtype=torch.int16 if frames <= _LONGEST else torch.int32)
    first = flat.new_empty(batch, pixels, dtype=torch.int32)
    launch(_next_spike_kernel, _blocks(flat), flat, following, first, frames, pixels, *flat.stride(), block=_BLOCK)
    result = following if dtype is None else flat.new_empty(flat.shape, dtype=dtype)
    arguments = following, first, result, _scalar(max_range, flat, wide_dtype(result)), frames, pixels
    launch(_interval_kernel, _blocks(flat), *arguments, as_light=dtype is not None, block=_BLOCK)
    return _as(spikes, result)


def spike_interval(spikes: Tensor) -> Tensor:
    """Read the spikes once, write the intervals twice and read them once."""
    return _intervals(spikes)


def tfi(spikes: Tensor, max_range: float, dtype: torch.dtype) -> Tensor:
    """Read the spikes once, write and read the next spike as int16, and write the light once."""
    return _intervals(spikes, max_range, dtype)


@triton.jit
def _window_size(n, half, frames):
    """Return the number of existing frames in the window around frame n."""
    return tl.minimum(n + half, frames - 1) - tl.maximum(n - half, 0) + 1


@triton.jit
def _term(
    values, n, exists, frames, step, half, max_range, pixel, pixels, counter: tl.constexpr, adjoint: tl.constexpr
):
    """Return the term of frame n in a window, 0 if there is no such frame."""
    value = tl.load(values + n * step, mask=pixel < tl.where(exists, pixels, 0), other=0).to(counter)
    if adjoint:
        value *= max_range / tl.maximum(_window_size(n, half, frames), 1).to(counter)
    return value


@triton.jit(do_not_specialize=["frames", "half"])
def _window_kernel(
    values, max_range, result, frames, half, pixels, values_b, values_t, values_p,
    counter: tl.constexpr, adjoint: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """Compute the mean over the window of every frame, or its adjoint, by a running sum.

    Every frame is read twice, as it enters and leaves the window, and the result is written once, for any window.
    """
    b, pixel, inside = my_pixels(pixels, block)
    values += b * values_b + pixel * values_p
    values_t = tl.cast(values_t, tl.int64)
    pixels = tl.cast(pixels, tl.int64)
    result += b * frames * pixels + pixel
    white = tl.load(max_range)
    total = tl.zeros([block], counter)
    for n in tl.range(half, num_stages=_STAGES):
        total += _term(values, n, n < frames, frames, values_t, half, white, pixel, pixels, counter, adjoint)
    for n in tl.range(frames, num_stages=_STAGES):
        enters, leaves = n + half, n - half - 1
        total += _term(values, enters, enters < frames, frames, values_t, half, white, pixel, pixels, counter, adjoint)
        total -= _term(values, leaves, leaves >= 0, frames, values_t, half, white, pixel, pixels, counter, adjoint)
        if adjoint:
            store(result + n * pixels, total, inside)
        else:
            size = _window_size(n, half, frames).to(white.dtype)
            store(result + n * pixels, _divide(total.to(white.dtype) * white, size), inside)


def _windows(values: Tensor, window: int, max_range: Tensor, dtype: torch.dtype, adjoint: bool) -> Tensor:
    flat = _flat(values)
    result = flat.new_empty(flat.shape, dtype=dtype)
    frames, pixels = flat.shape[1:]
    sizes = frames, min(window // 2, frames), pixels, *flat.stride()
    if values.is_floating_point():
        count = tl.float64  # so that rounding errors of large values do not remain in the running sum
    else:
        count = tl.int32 if values.dtype in (torch.bool, torch.uint8) else tl.int64
    constants = {"counter": count, "adjoint": adjoint, "block": _BLOCK}
    launch(_window_kernel, _blocks(flat), flat, max_range, result, *sizes, **constants)
    return _as(values, result)


def tfp(spikes: Tensor, window: int, max_range: float, dtype: torch.dtype) -> Tensor:
    """Read the spikes twice and write the light once, for any window."""
    wide = torch.float64 if torch.float64 in (spikes.dtype, dtype) else torch.float32
    return _windows(spikes, window, _scalar(max_range, spikes, wide), dtype, False)


def tfp_grad(grad: Tensor, window: int, max_range: float, dtype: torch.dtype) -> Tensor:
    """Read the gradient twice and write the result once."""
    return _windows(grad, window, _scalar(max_range, grad, torch.float64), dtype, True)
