"""Decoders of a single frame, which read only the frames that determine it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor
from torch.compiler import is_exporting

from spikekit.check import check_dtype, check_index, check_planes, check_positive, check_whole, default_float
from spikekit.decoders.dense import cast_light, check_window, interval_dtype, rate_of
from spikekit.kernels import operator, register_kernel


def _spike_interval_at(spikes: Tensor, frame: int) -> Tensor:
    fired = spikes != 0
    after, gap_after = _look(fired[..., frame:, :, :])
    before, gap_before = _look(fired[..., :frame, :, :].flip(-3))
    frames = spikes.shape[-3]
    gap = torch.where(before == frame, gap_after, torch.where(after == frames - frame, gap_before, 0))
    return torch.maximum(before + after + 1, gap).to(interval_dtype(frames))


_operator = operator(
    lambda spikes, frame: spikes.new_empty(spikes[..., 0, :, :].shape, dtype=interval_dtype(spikes.shape[-3]))
)(_spike_interval_at)


def _look(fired: Tensor) -> tuple[Tensor, Tensor]:
    """Count the planes before the first spike (all if there is none), and from it to the second (0 if none)."""
    planes = fired.shape[-3]
    if planes == 0:
        none = fired.new_zeros(fired.shape[:-3] + fired.shape[-2:], dtype=torch.int64)
        return none, none
    first = torch.where(fired.any(-3), fired.byte().argmax(-3), planes)
    later = fired & (torch.arange(planes, device=fired.device)[:, None, None] > first.unsqueeze(-3))
    return first, torch.where(later.any(-3), later.byte().argmax(-3) - first, 0)


@register_kernel(_operator, "cpu")
def _(spikes: Tensor, frame: int) -> Tensor:
    frames = spikes.shape[-3]
    planes = spikes.detach().movedim(-3, 0)
    if spikes.dtype in (torch.uint8, torch.bool):
        return torch.from_numpy(search(planes.view(torch.uint8).numpy().__getitem__, frame, range(frames)))
    return torch.from_numpy(search(lambda n: (planes[n] != 0).view(torch.uint8).numpy(), frame, range(frames)))


def search(plane: Callable[[int], np.ndarray], frame: int, clip: range) -> np.ndarray:
    """Find the intervals at one frame, loading only the frames that are needed.

    ``plane`` returns the frame of a given number, uint8, where any value but 0 is a spike. ``clip`` holds the numbers
    of all frames.
    """
    size, counter = plane(frame).shape, np.int16 if len(clip) < 32767 else np.int32
    onwards, backwards = range(frame, clip.stop), range(frame - 1, clip.start - 1, -1)
    after, none_after = _silence(map(plane, onwards), size, counter)
    before, none_before = _silence(map(plane, backwards), size, counter)
    interval = after + before + 1
    # if one of the two spikes is missing, the nearest complete interval lies on the other side
    for order, alone in ((onwards, none_before & ~none_after), (backwards, none_after & ~none_before)):
        if alone.any():
            np.maximum(interval, _first_interval(map(plane, order), alone, counter), out=interval)
    return interval


def _silence(planes: Iterable[np.ndarray], size: tuple[int, ...], counter: type) -> tuple[np.ndarray, np.ndarray]:
    """Count the planes before the first spike of every pixel (all if there is none); also return which have none."""
    silent, count = np.ones(size, bool), np.zeros(size, counter)
    for plane in planes:
        np.greater(silent.view(np.uint8), plane, out=silent)
        count += silent
        if not silent.any():
            break
    return count, silent


def _first_interval(planes: Iterable[np.ndarray], wanted: np.ndarray, counter: type) -> np.ndarray:
    """Count the planes from the first spike to the second at the ``wanted`` pixels; 0 if there is no second."""
    waiting, once, count = wanted.copy(), np.zeros_like(wanted), np.zeros(wanted.shape, counter)
    for plane in planes:
        fired = plane != 0
        np.greater(waiting, once & fired, out=waiting)
        once |= fired
        count += waiting & once
        if not waiting.any():
            break
    return count * ~waiting


def spike_interval_at(spikes: Tensor, frame: int) -> Tensor:
    r"""Distance between the two spikes that enclose one frame.

    .. math:: \Psi_n = \min\{k \mid S_k = 1, k \ge n\} - \max\{k \mid S_k = 1, k < n\}

    Convention:
        Equals ``spike_interval(spikes)[..., frame, :, :]``, also near the ends of the clip, at the cost of a few
        frames: on the CPU, frames are read outwards from this one until every pixel has fired on both sides. No
        gradient.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.
        frame: n, from 0 to T - 1.

    Returns:
        The intervals in frames, :math:`(*, H, W)`, in the dtype of :func:`spikekit.spike_interval`.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers, or ``frame`` is not a whole number.
        ValueError: ``spikes`` has fewer than three dimensions or is empty, or ``frame`` is out of range.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 0, 1, 0], dtype=torch.uint8).reshape(6, 1, 1)
        >>> spike_interval_at(spikes, 3).item()
        3

    Reference:
        Dong et al., CVPR 2024, eq. (4); Zhu et al., ICME 2019.
    """
    interval = _interval(spikes, frame)
    return interval.to(spikes.dtype) if spikes.is_floating_point() else interval


def tfi_at(spikes: Tensor, frame: int, max_range: float = 1.0, *, dtype: torch.dtype | None = None) -> Tensor:
    r"""Texture from interval at one frame, the key frame.

    .. math:: R_n = \delta / \Psi_n

    Convention:
        Equals ``tfi(spikes, max_range, dtype=dtype)[..., frame, :, :]``, bit for bit, at the cost of a few frames; see
        :func:`spike_interval_at`. No gradient.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.
        frame: n, from 0 to T - 1.
        max_range: :math:`\delta`, the value of a pixel that fires at every clock.
        dtype: dtype of the result, floating or uint8; default: that of ``spikes`` if floating, else torch's default.

    Returns:
        Raw intensities :math:`(*, H, W)`.

    Raises:
        TypeError: as :func:`spike_interval_at`, or ``dtype`` is neither floating nor uint8.
        ValueError: as :func:`spike_interval_at`, or ``max_range`` is not above 0.

    Example:
        >>> tfi_at(torch.tensor([0, 1, 0, 1]).reshape(4, 1, 1), 2)
        tensor([[0.5000]])

    Reference:
        Dong et al., CVPR 2024, eq. (5); Zhu et al., ICME 2019.
    """
    check_dtype(dtype, torch.uint8)
    check_positive("max_range", max_range)
    return rate_of(_interval(spikes, frame), max_range, dtype or default_float(spikes))


def tfp_at(
    spikes: Tensor,
    frame: int,
    window: int,
    max_range: float = 1.0,
    *,
    order: int = 1,
    dtype: torch.dtype | None = None,
) -> Tensor:
    r"""Texture from playback at one frame, the key frame: a weighted sum of the frames in its window.

    .. math:: R_n = \delta \sum_k w_k S_{n + k}, \quad \sum_k w_k = 1

    Convention:
        Equals ``tfp(spikes, window, max_range, order=order, dtype=dtype)[..., frame, :, :]`` up to rounding; sums are
        computed in float32 or wider. Linear in the spikes, and differentiable as such.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.
        frame: n, from 0 to T - 1.
        window: number of frames of the mean, odd.
        max_range: :math:`\delta`, the value of a pixel that fires at every clock.
        order: how many times the mean is taken, see :func:`spikekit.tfp`.
        dtype: dtype of the result, floating or uint8; default: that of ``spikes`` if floating, else torch's default.

    Returns:
        Raw intensities :math:`(*, H, W)`.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers, ``frame`` is not a whole number, or ``dtype`` is neither
            floating nor uint8.
        ValueError: ``spikes`` has fewer than three dimensions or is empty, ``frame`` is out of range, ``window`` is
            even or below 1, ``order`` is below 1, or ``max_range`` is not above 0.

    Example:
        >>> tfp_at(torch.tensor([0, 1, 0, 1]).reshape(4, 1, 1), 2, 3)
        tensor([[0.6667]])

    Reference:
        Dong et al., CVPR 2024, eq. (6); Zhu et al., ICME 2019.
    """
    frame = _check_frame(spikes, frame)
    window, order = check_window(window), check_whole("order", order)
    check_positive("max_range", max_range)
    check_dtype(dtype, torch.uint8)
    dtype = dtype or default_float(spikes)
    first, weights = tfp_weights(spikes.shape[-3], frame, window, order)
    between = torch.float64 if torch.float64 in (dtype, spikes.dtype) else torch.float32
    light = spikes[..., first, :, :].to(between) * (max_range * weights[0])
    for n, weight in enumerate(weights[1:], first + 1):  # frame by frame, as larger buffers are slower
        light.add_(spikes[..., n, :, :], alpha=max_range * weight)
    return cast_light(light, dtype)


def tfp_weights(frames: int, frame: int, window: int, order: int) -> tuple[int, list[float]]:
    """Return the first frame that contributes to the repeated mean at ``frame``, and the weights from it on."""
    half = window // 2
    first, last = max(frame - order * half, 0), min(frame + order * half, frames - 1)
    seen = range(first, last + 1)
    weights = [float(n == frame) for n in seen]
    for _ in range(order):
        shares = [w / (min(n + half, frames - 1) - max(n - half, 0) + 1) for n, w in zip(seen, weights, strict=True)]
        total = [0.0, *accumulate(shares)]
        weights = [total[min(n + half, last) - first + 1] - total[max(n - half, first) - first] for n in seen]
    return first, weights


def _interval(spikes: Tensor, frame: int) -> Tensor:
    frame = _check_frame(spikes, frame)
    # exported models cannot use custom operators
    find = _spike_interval_at if is_exporting() else _operator
    return find(spikes.detach(), frame)


def _check_frame(spikes: Tensor, frame: int) -> int:
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    frame = check_index("frame", frame)
    if not 0 <= frame < spikes.shape[-3]:
        raise ValueError(f"frame: expected 0 .. {spikes.shape[-3] - 1}, got {frame}")
    return frame
