"""The decoders: from spikes to light, by the interval between spikes (TFI) or by their number (TFP)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from spikekit.check import check_planes, check_positive, default_float


# The loops over time are custom operators: torch.compile would unroll them.
@torch.library.custom_op("spikekit::spike_interval", mutates_args=())
def _spike_interval(fired: Tensor) -> Tensor:
    frames = fired.shape[-3]
    interval = torch.empty_like(fired, dtype=_interval_dtype(frames))
    planes = list(zip(fired.unbind(-3), interval.unbind(-3), strict=True))

    # Backwards: the next spike, T where there is none; what remains in `first` is the first complete interval.
    following = torch.full_like(planes[0][1], frames)
    first = torch.zeros_like(following)
    for n in reversed(range(frames)):
        fired_n, next_n = planes[n]
        first = torch.where(fired_n & (following < frames), following - n, first)
        following = following.masked_fill(fired_n, n)
        next_n.copy_(following)

    # Forwards: the last spike before n, -1 where there is none; `last` is the latest complete interval.
    previous = torch.full_like(following, -1)
    last = torch.zeros_like(following)
    for n, (fired_n, interval_n) in enumerate(planes):
        complete = torch.where(previous < 0, first, last.masked_fill(interval_n < frames, 0))
        torch.maximum(interval_n - previous, complete, out=interval_n)
        last = torch.where(fired_n & (previous >= 0), n - previous, last)
        previous = previous.masked_fill(fired_n, n)
    return interval


@_spike_interval.register_fake
def _(fired: Tensor) -> Tensor:
    return torch.empty_like(fired, dtype=_interval_dtype(fired.shape[-3]))


def _interval_dtype(frames: int) -> torch.dtype:
    return torch.int16 if frames < 32767 else torch.int32


@torch.library.custom_op("spikekit::sum_intervals", mutates_args=())
def _sum_intervals(value: Tensor, fired: Tensor) -> Tensor:
    """Sum ``value`` over every interval (last spike before n, first spike at or after n], and spread the sum on it."""
    total = torch.empty_like(value)
    planes = list(zip(value.unbind(-3), fired.unbind(-3), total.unbind(-3), strict=True))
    running = torch.zeros_like(planes[0][0], dtype=torch.promote_types(value.dtype, torch.float32))
    sums = []
    for value_n, fired_n, _ in planes:
        running = running + value_n
        sums.append(running)
        running = running.masked_fill(fired_n, 0)
    spread = sums[-1]
    for running, (_, fired_n, total_n) in zip(reversed(sums), reversed(planes), strict=True):
        spread = torch.where(fired_n, running, spread)
        total_n.copy_(spread)
    return total


@_sum_intervals.register_fake
def _(value: Tensor, fired: Tensor) -> Tensor:
    return torch.empty_like(value)


@torch.library.custom_op("spikekit::tfi", mutates_args=())
def _tfi(spikes: Tensor, max_range: float) -> Tensor:
    interval = _spike_interval(spikes != 0)
    wide = torch.promote_types(spikes.dtype, torch.float32)
    # a tensor over a tensor: torch divides a number by a tensor through the inverse, and 255 / 5 is not 51 then
    return (torch.full_like(interval, max_range, dtype=wide) / interval).to(spikes.dtype)


@_tfi.register_fake
def _(spikes: Tensor, max_range: float) -> Tensor:
    return torch.empty_like(spikes)


def _save_tfi(ctx: Any, inputs: tuple[Tensor, float], output: Tensor) -> None:
    ctx.save_for_backward(inputs[0], output)


def _tfi_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
    spikes, rate = ctx.saved_tensors
    return _sum_intervals(grad, spikes != 0) * rate, None


_tfi.register_autograd(_tfi_backward, setup_context=_save_tfi)


def spike_interval(spikes: Tensor) -> Tensor:
    r"""Distance between the two spikes that enclose every frame.

    .. math:: \Psi_n = \min\{k \mid S_k = 1, k \ge n\} - \max\{k \mid S_k = 1, k < n\}

    Convention:
        Time is axis -3; the spike at n itself closes the interval of frame n. Where one of the two spikes is missing,
        the estimate is the nearest complete interval of the pixel, but never less than the time already waited,
        counted from a virtual spike just outside the clip (at -1 or T). So the result is finite and at least 1; a
        pixel without spikes gives T + 1. Any value but 0 is a spike. No gradient.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.

    Returns:
        The intervals in frames, :math:`(*, T, H, W)`: in the dtype of ``spikes`` where that is floating, else int16
        (int32 from T = 32767 on).

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: fewer than three dimensions, or an empty clip.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 0, 1, 0], dtype=torch.uint8).reshape(6, 1, 1)
        >>> spike_interval(spikes).flatten().tolist()
        [3, 3, 3, 3, 3, 3]

    Reference:
        Dong et al., CVPR 2024, eq. (4); Zhu et al., ICME 2019.
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    interval = _spike_interval(spikes != 0)
    return interval.to(spikes.dtype) if spikes.is_floating_point() else interval


class SpikeInterval(nn.Module):
    r"""See the Convention block on :func:`spike_interval`.

    Shape:
        - Input: :math:`(*, T, H, W)`
        - Output: :math:`(*, T, H, W)`

    Example:
        >>> SpikeInterval()(torch.ones(4, 2, 2, dtype=torch.bool)).unique().tolist()
        [1]
    """

    def forward(self, spikes: Tensor) -> Tensor:  # noqa: D102
        return spike_interval(spikes)


def tfi(spikes: Tensor, max_range: float = 1.0) -> Tensor:
    r"""Texture from interval: light as the inverse of the spike interval, at every frame.

    .. math:: R_n = \delta / \Psi_n

    Convention:
        Time is axis -3, intervals as in :func:`spike_interval`. A pixel that fires at every clock gives ``max_range``;
        light of a simulated scene with gain alpha is the result divided by alpha.

        The gradient treats TFI as TFP with the window that the spikes themselves chose:
        :math:`\partial R_n / \partial S_k = \delta / \Psi_n` for k in (last spike before n, first spike at or after
        n], 0 outside.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.
        max_range: :math:`\delta`, the value of a pixel that fires at every clock.

    Returns:
        Raw intensities :math:`(*, T, H, W)`, in the dtype of ``spikes`` where that is floating, else in torch's
        default type.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: fewer than three dimensions, an empty clip, ``max_range`` not above 0.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 1]).reshape(4, 1, 1)
        >>> tfi(spikes).flatten().tolist()
        [0.5, 0.5, 0.5, 0.5]

    Reference:
        Dong et al., CVPR 2024, eq. (5); Zhu et al., ICME 2019.
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    check_positive("max_range", max_range)
    return _tfi(spikes.to(default_float(spikes)), float(max_range))


class Tfi(nn.Module):
    r"""See the Convention block on :func:`tfi`.

    Shape:
        - Input: :math:`(*, T, H, W)`
        - Output: :math:`(*, T, H, W)`

    Example:
        >>> Tfi(max_range=255.0)(torch.ones(41, 2, 2)).max().item()
        255.0
    """

    def __init__(self, max_range: float = 1.0) -> None:
        super().__init__()
        check_positive("max_range", max_range)
        self.max_range = max_range

    def forward(self, spikes: Tensor) -> Tensor:  # noqa: D102
        return tfi(spikes, self.max_range)

    def extra_repr(self) -> str:  # noqa: D102
        return f"max_range={self.max_range}"


def tfp(spikes: Tensor, window: int, max_range: float = 1.0) -> Tensor:
    r"""Texture from playback: light as the mean number of spikes in a window around every frame.

    .. math:: R_n = \frac{\delta}{w} \sum_{|i - n| \le (w - 1) / 2} S_i

    Convention:
        Time is axis -3; the window is centred. Near the ends of the clip it is cut, and the mean is over the frames
        that exist, so a window longer than the clip is legal. Linear in the spikes, and differentiable as such; sums
        run in float32 or wider.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.
        window: number of frames, odd.
        max_range: :math:`\delta`, the value of a pixel that fires at every clock.

    Returns:
        Raw intensities :math:`(*, T, H, W)`, in the dtype of ``spikes`` where that is floating, else in torch's
        default type.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: fewer than three dimensions, an empty clip, an even window or one below 1, ``max_range`` not
            above 0.

    Example:
        >>> spikes = torch.tensor([1, 0, 0, 1]).reshape(4, 1, 1)
        >>> tfp(spikes, 3).flatten().tolist()
        [0.5, 0.333..., 0.333..., 0.5]

    Reference:
        Dong et al., CVPR 2024, eq. (6); Zhu et al., ICME 2019.
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    _check_window(window)
    check_positive("max_range", max_range)
    dtype = default_float(spikes)
    wide = torch.promote_types(dtype, torch.float32)
    frames, half = spikes.shape[-3], window // 2
    counts = torch.cumsum(spikes, dim=-3, dtype=wide if spikes.is_floating_point() else torch.int32)
    counts = torch.cat([torch.zeros_like(counts[..., :1, :, :]), counts], dim=-3)
    n = torch.arange(frames, device=spikes.device)
    begin, end = (n - half).clamp(min=0), (n + half + 1).clamp(max=frames)
    inside = counts.index_select(-3, end) - counts.index_select(-3, begin)
    return (inside.to(wide) * max_range / (end - begin)[:, None, None]).to(dtype)


def _check_window(window: int) -> None:
    if isinstance(window, bool) or not isinstance(window, int) or window < 1 or window % 2 == 0:
        raise ValueError(f"window: expected an odd number of frames, 1 or more, got {window!r}")


class Tfp(nn.Module):
    r"""See the Convention block on :func:`tfp`.

    Shape:
        - Input: :math:`(*, T, H, W)`
        - Output: :math:`(*, T, H, W)`

    Example:
        >>> Tfp(window=11)(torch.ones(41, 2, 2)).min().item()
        1.0
    """

    def __init__(self, window: int, max_range: float = 1.0) -> None:
        super().__init__()
        _check_window(window)
        check_positive("max_range", max_range)
        self.window = window
        self.max_range = max_range

    def forward(self, spikes: Tensor) -> Tensor:  # noqa: D102
        return tfp(spikes, self.window, self.max_range)

    def extra_repr(self) -> str:  # noqa: D102
        return f"window={self.window}, max_range={self.max_range}"
