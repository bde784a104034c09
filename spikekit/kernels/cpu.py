"""NumPy kernels of the sensor and the decoders on the CPU, tile by tile, so that reused data stay in the cache.

Every function takes the arguments of the custom operator of the same name and returns the result of its torch path. A
tile has about 64 k pixels, and loops over time run within a tile.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from spikekit.kernels.layout import new_tensor

_TILE = 1 << 16  # pixels

_Slices = tuple[slice, slice]


def _wide(*dtypes: torch.dtype) -> type[np.floating]:
    """Return the dtype to compute in; half precision is widened tile by tile."""
    return np.float64 if torch.float64 in dtypes else np.float32


def _flat(stream: Tensor) -> Tensor:
    """Reshape (*, T, H, W) to (B, T, P), as a view if possible."""
    lead, (frames, height, width) = stream.shape[:-3], stream.shape[-3:]
    return stream.detach().reshape(math.prod(lead), frames, height * width)


def _tiles(batch: int, pixels: int) -> Iterator[_Slices]:
    several = max(_TILE // pixels, 1)
    part = -(-pixels // -(-pixels // _TILE))  # equal tiles within a plane
    for b in range(0, batch, several):
        for p in range(0, pixels, part):
            yield slice(b, b + several), slice(p, p + part)


def _read(flat: Tensor, tile: _Slices) -> np.ndarray:
    """Return a tile as (T, b, p): a view, with bool as uint8, or a float32 copy of half precision."""
    part = flat[tile[0], :, tile[1]].movedim(1, 0)
    if part.dtype is torch.bool:
        part = part.view(torch.uint8)
    return (part.float() if part.dtype in (torch.bfloat16, torch.float16) else part).numpy()


class _Output:
    """An output that is filled tile by tile, through a float32 buffer for half precision."""

    def __init__(self, shape: torch.Size, dtype: torch.dtype) -> None:
        self.tensor = new_tensor(shape, dtype)
        self._flat = _flat(self.tensor)
        self._through_buffer = dtype in (torch.bfloat16, torch.float16)

    def tiles(self) -> Iterator[tuple[_Slices, np.ndarray]]:
        """Yield the slices of every tile and an array (T, b, p) to write to."""
        batch, _, pixels = self._flat.shape
        for tile in _tiles(batch, pixels):
            part = self._flat[tile[0], :, tile[1]].movedim(1, 0)
            if self._through_buffer:
                buffer = np.empty(part.shape, np.float32)
                yield tile, buffer
                part.copy_(torch.from_numpy(buffer))
            else:
                yield tile, part.numpy()


def integrate_fire(light: Tensor, threshold: float, charge: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Read the light once and write the spikes once."""
    spikes = _Output(light.shape, dtype)
    left = torch.from_numpy(charge.detach().numpy().copy())
    lights, charges = _flat(light), _flat(left.unsqueeze(-3))[:, 0].numpy()
    theta = charges.dtype.type(threshold)
    for tile, spikes_tile in spikes.tiles():
        charges[tile] = _integrate_tile(_read(lights, tile), theta, charges[tile], spikes_tile)
    return spikes.tensor, left


def _integrate_tile(light: np.ndarray, theta: np.floating, charge: np.ndarray, spikes: np.ndarray) -> np.ndarray:
    charge = charge.copy()
    full, rest = np.empty_like(charge), np.empty_like(charge)
    full_bits, rest_bits, charge_bits = (a.view(f"u{a.itemsize}") for a in (full, rest, charge))
    fired = np.empty(charge.shape, bool)
    with np.errstate(invalid="ignore", over="ignore"):
        for light_t, spikes_t in zip(light, spikes, strict=True):
            np.add(charge, light_t, out=full)
            np.greater_equal(full, theta, out=fired)
            np.copyto(spikes_t, fired)
            np.subtract(full, theta, out=rest)
            # The minimum as unsigned integers: `rest` if it is not negative, else `full`.
            np.minimum(full_bits, rest_bits, out=charge_bits)
            if not charge.max() < theta:  # also true for NaN
                over = charge >= theta
                several = full[over]
                remainder = several - np.floor(several / theta) * theta
                charge[over] = np.where((remainder >= 0) & (remainder < theta), remainder, 0)
    return charge


def spike_interval(spikes: Tensor) -> Tensor:
    """Read the spikes once, write the intervals twice."""
    interval = _Output(spikes.shape, torch.int16 if spikes.shape[-3] < 32767 else torch.int32)
    flat = _flat(spikes)
    for tile, out in interval.tiles():
        _interval_tile(_read(flat, tile), out)
    return interval.tensor


def _interval_tile(spikes: np.ndarray, interval: np.ndarray) -> None:
    frames, *plane = spikes.shape
    one = interval.dtype.type(1)
    silent, factor, step = np.empty(plane, bool), np.empty(plane, interval.dtype), np.empty(plane, interval.dtype)

    # Backwards: the distance to the next spike, or to T if there is none.
    ahead = np.zeros(plane, interval.dtype)
    for spikes_n, ahead_n in zip(spikes[::-1], interval[::-1], strict=True):
        np.equal(spikes_n, 0, out=silent)
        np.copyto(factor, silent)
        np.add(ahead, one, out=step)
        np.multiply(step, factor, out=ahead_n)
        ahead = ahead_n

    # The first interval is at least as long as the first complete one, and starts at -1 at the latest.
    first = interval[0].astype(np.int64)
    after = np.minimum(first + 1, frames - 1)
    second = after + np.take_along_axis(interval, after[None], axis=0)[0]
    complete = (first < frames - 1) & (second < frames)
    behind = np.where(complete, np.maximum(second - 2 * first, 1), 1).astype(interval.dtype)

    # Forwards: plus the distance to the last spike before.
    for interval_n in interval:
        np.not_equal(interval_n, 0, out=silent)
        np.copyto(factor, silent)
        np.add(interval_n, behind, out=interval_n)
        np.multiply(behind, factor, out=behind)
        np.add(behind, one, out=behind)

    # After the last spike: at least the last complete interval.
    last = frames - behind  # -1 for a pixel without spikes
    complete = np.take_along_axis(interval, last.astype(np.int64).clip(0)[None], axis=0)[0]
    missing = np.where(last > first, np.maximum(complete - behind, 0), 0).astype(interval.dtype)
    for n in range(int(last[missing > 0].min(initial=frames)) + 1, frames):
        np.less(last, n, out=silent)
        np.copyto(factor, silent)
        np.multiply(factor, missing, out=factor)
        np.add(interval[n], factor, out=interval[n])


def tfi(spikes: Tensor, max_range: float, dtype: torch.dtype) -> Tensor:
    """Read the spikes once and write the light once, with a buffer for the intervals of a tile."""
    light = _Output(spikes.shape, dtype)
    flat = _flat(spikes)
    counter = np.int16 if spikes.shape[-3] < 32767 else np.int32
    white = _wide(dtype)(max_range)
    for tile, out in light.tiles():
        interval = np.empty(out.shape, counter)
        _interval_tile(_read(flat, tile), interval)
        rate = np.empty(out.shape[1:], white.dtype)
        for interval_n, out_n in zip(interval, out, strict=True):
            into = out_n if out_n.dtype == rate.dtype else rate
            np.divide(white, interval_n, out=into, dtype=rate.dtype)
            _store(into, out_n)
    return light.tensor


def _store(value: np.ndarray, out: np.ndarray) -> None:
    """Write a plane of floats; for uint8, round to the nearest whole number and clamp."""
    if value is out:
        return
    if out.dtype == np.uint8:
        np.rint(value, out=value)
        np.clip(value, 0, 255, out=value)
    np.copyto(out, value, casting="unsafe")


def tfp(spikes: Tensor, window: int, max_range: float, dtype: torch.dtype) -> Tensor:
    """Read the spikes twice, as they enter and leave the window, and write the light once, for any window."""
    light = _Output(spikes.shape, dtype)
    flat = _flat(spikes)
    wide = np.dtype(_wide(spikes.dtype, dtype))
    sizes = _window_sizes(spikes.shape[-3], window).astype(wide)
    for tile, out in light.tiles():
        values, mean = _read(flat, tile), np.empty(out.shape[1:], wide)
        for total, size, out_n in zip(_running_sums(values, window), sizes, out, strict=True):
            np.copyto(mean, total, casting="same_kind")
            if max_range != 1:
                np.multiply(mean, wide.type(max_range), out=mean)
            into = out_n if out_n.dtype == wide else mean
            np.divide(mean, size, out=into)
            _store(into, out_n)
    return light.tensor


def tfp_grad(grad: Tensor, window: int, max_range: float, dtype: torch.dtype) -> Tensor:
    """Compute the same running sum over the gradient, divided by the window size of each frame."""
    result = _Output(grad.shape, dtype)
    flat = _flat(grad)
    weights = max_range / _window_sizes(grad.shape[-3], window)
    for tile, out in result.tiles():
        for total, out_n in zip(_running_sums(_read(flat, tile), window, weights), out, strict=True):
            np.copyto(out_n, total, casting="same_kind")
    return result.tensor


def _window_sizes(frames: int, window: int) -> np.ndarray:
    """Return the number of existing frames in the window around every frame."""
    n, half = np.arange(frames), window // 2
    return np.minimum(n + half, frames - 1) - np.maximum(n - half, 0) + 1


def _running_sums(values: np.ndarray, window: int, weights: np.ndarray | None = None) -> Iterator[np.ndarray]:
    """Yield the weighted sum over the window of every frame, in an array that is reused."""
    frames, half = len(values), window // 2
    if values.dtype.kind == "f":
        counter = np.dtype(np.float64)  # else large values would leave rounding errors in the running sum
    elif values.dtype == np.uint8:
        counter = np.min_scalar_type(window * int(values.max(initial=0)))
    else:
        counter = np.dtype(np.uint64 if values.dtype == np.uint64 else np.int64)
    total, weighed = np.zeros(values.shape[1:], counter), np.empty(values.shape[1:], counter)

    def weigh(n: int) -> np.ndarray:
        return values[n] if weights is None else np.multiply(values[n], weights[n], out=weighed)

    for n in range(min(half, frames)):
        np.add(total, weigh(n), out=total, casting="same_kind")
    for n in range(frames):
        if n + half < frames:
            np.add(total, weigh(n + half), out=total, casting="same_kind")
        if n > half:
            np.subtract(total, weigh(n - half - 1), out=total, casting="same_kind")
        yield total
