"""Decoders from spikes to light: by the interval between spikes (TFI), or by their number in a window (TFP)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from spikekit.check import check_dtype, check_planes, check_positive, check_whole, default_float
from spikekit.kernels import operator
from spikekit.options_module import OptionsModule


# The loops over time are custom operators, as torch.compile would unroll them.
@operator(lambda spikes: torch.empty_like(spikes, dtype=interval_dtype(spikes.shape[-3])))
def _spike_interval(spikes: Tensor) -> Tensor:
    fired, frames = spikes != 0, spikes.shape[-3]
    interval = torch.empty_like(fired, dtype=interval_dtype(frames))
    planes = list(zip(fired.unbind(-3), interval.unbind(-3), strict=True))

    # Backwards: the next spike, T if there is none; `first` ends as the first complete interval.
    following = torch.full_like(planes[0][1], frames)
    first = torch.zeros_like(following)
    for n in reversed(range(frames)):
        fired_n, next_n = planes[n]
        first = torch.where(fired_n & (following < frames), following - n, first)
        following = following.masked_fill(fired_n, n)
        next_n.copy_(following)

    # Forwards: the last spike before n, -1 if there is none; `last` is the latest complete interval.
    previous = torch.full_like(following, -1)
    last = torch.zeros_like(following)
    for n, (fired_n, interval_n) in enumerate(planes):
        complete = torch.where(previous < 0, first, last.masked_fill(interval_n < frames, 0))
        torch.maximum(interval_n - previous, complete, out=interval_n)
        last = torch.where(fired_n & (previous >= 0), n - previous, last)
        previous = previous.masked_fill(fired_n, n)
    return interval


def interval_dtype(frames: int) -> torch.dtype:
    """Return the smallest dtype that holds every interval of a clip."""
    return torch.int16 if frames < 32767 else torch.int32


@operator(lambda spikes, max_range, dtype: torch.empty_like(spikes, dtype=dtype))
def _tfi(spikes: Tensor, max_range: float, dtype: torch.dtype) -> Tensor:
    return rate_of(torch.ops.spikekit.spike_interval(spikes), max_range, dtype)


def rate_of(interval: Tensor, max_range: float, dtype: torch.dtype) -> Tensor:
    """Return ``max_range / interval``."""
    # tensor / tensor: torch computes number / tensor by the reciprocal, so that 255 / 5 is not 51
    most = torch.full_like(interval, max_range, dtype=torch.promote_types(dtype, torch.float32))
    return cast_light(most / interval, dtype)


def cast_light(value: Tensor, dtype: torch.dtype) -> Tensor:
    """Cast to ``dtype``; uint8 is rounded to the nearest whole number and clamped."""
    return value.round().clamp(0, 255).to(dtype) if dtype is torch.uint8 else value.to(dtype)


@operator(lambda grad, spikes, rate: torch.empty_like(spikes))
def _tfi_grad(grad: Tensor, spikes: Tensor, rate: Tensor) -> Tensor:
    """Sum the gradient over (last spike before n, first spike at or after n], and multiply it by the rate there."""
    result = torch.empty_like(spikes)
    planes = list(zip(grad.unbind(-3), (spikes != 0).unbind(-3), rate.unbind(-3), result.unbind(-3), strict=True))
    running = torch.zeros_like(planes[0][0], dtype=torch.promote_types(spikes.dtype, torch.float32))
    sums = []
    for grad_n, fired_n, _, _ in planes:
        running = running + grad_n
        sums.append(running)
        running = running.masked_fill(fired_n, 0)
    spread = sums[-1]
    for running, (_, fired_n, rate_n, result_n) in zip(reversed(sums), reversed(planes), strict=True):
        spread = torch.where(fired_n, running, spread)
        result_n.copy_(spread * rate_n)
    return result


class _Tfi(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(spikes: Tensor, max_range: float, dtype: torch.dtype) -> Tensor:
        return _tfi(spikes, max_range, dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return _SumOnIntervals.apply(grad, *ctx.saved_tensors), None, None


class _SumOnIntervals(_Tfi):
    """Gradient of TFI, which is linear in the incoming gradient and self-adjoint, and therefore its own gradient."""

    @staticmethod
    def forward(grad: Tensor, spikes: Tensor, rate: Tensor) -> Tensor:
        return _tfi_grad(grad, spikes, rate)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:])


@operator(lambda spikes, window, max_range, dtype: torch.empty_like(spikes, dtype=dtype))
def _tfp(spikes: Tensor, window: int, max_range: float, dtype: torch.dtype) -> Tensor:
    wide = torch.promote_types(torch.promote_types(dtype, torch.float32), spikes.dtype)
    total = _inside(spikes, window, wide if spikes.is_floating_point() else torch.int32)
    return cast_light(total.to(wide) * max_range / _window_sizes(spikes, window), dtype)


@operator(lambda grad, window, max_range, dtype: torch.empty_like(grad, dtype=dtype))
def _tfp_grad(grad: Tensor, window: int, max_range: float, dtype: torch.dtype) -> Tensor:
    """Adjoint of TFP: distribute the gradient of every frame over the frames of its window."""
    wide = torch.promote_types(torch.promote_types(dtype, torch.float32), grad.dtype)
    share = grad.to(wide) * max_range / _window_sizes(grad, window)
    return _inside(share, window, wide).to(dtype)


def _ends(values: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Return the first frame of the window around every frame, and the first one after it."""
    n, half = torch.arange(values.shape[-3], device=values.device), window // 2
    return (n - half).clamp(min=0), (n + half + 1).clamp(max=values.shape[-3])


def _window_sizes(values: Tensor, window: int) -> Tensor:
    begin, end = _ends(values, window)
    return (end - begin)[:, None, None]


def _inside(values: Tensor, window: int, dtype: torch.dtype) -> Tensor:
    begin, end = _ends(values, window)
    sums = torch.cumsum(values, dim=-3, dtype=dtype)
    sums = torch.cat([torch.zeros_like(sums[..., :1, :, :]), sums], dim=-3)
    return sums.index_select(-3, end) - sums.index_select(-3, begin)


class _Tfp(torch.autograd.Function):
    """TFP or its adjoint; each is the gradient of the other."""

    generate_vmap_rule = True

    @staticmethod
    def forward(values: Tensor, window: int, max_range: float, dtype: torch.dtype, adjoint: bool) -> Tensor:
        return (_tfp_grad if adjoint else _tfp)(values, window, max_range, dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        values, *ctx.options, _, ctx.adjoint = inputs
        ctx.dtype = values.dtype

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None, None]:
        return _Tfp.apply(grad, *ctx.options, ctx.dtype, not ctx.adjoint), None, None, None, None


def spike_interval(spikes: Tensor) -> Tensor:
    r"""Distance between the two spikes that enclose every frame.

    .. math:: \Psi_n = \min\{k \mid S_k = 1, k \ge n\} - \max\{k \mid S_k = 1, k < n\}

    Convention:
        Time is axis -3; a spike at n itself ends the interval of frame n. If one of the two spikes is missing, the
        estimate is the nearest complete interval of the pixel, but at least the time already waited, counted from a
        virtual spike just outside the clip (at -1 or T). The result is therefore finite and at least 1; a pixel without
        spikes gives T + 1. Any value but 0 is a spike. No gradient.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.

    Returns:
        The intervals in frames, :math:`(*, T, H, W)`, in the dtype of ``spikes`` if that is floating, else int16
        (int32 from T = 32767 on). float16 is exact up to 2048 and limited to 65504.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: ``spikes`` has fewer than three dimensions or is empty.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 0, 1, 0], dtype=torch.uint8).reshape(6, 1, 1)
        >>> spike_interval(spikes).flatten().tolist()
        [3, 3, 3, 3, 3, 3]

    Reference:
        Dong et al., CVPR 2024, eq. (4); Zhu et al., ICME 2019.
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    interval = _spike_interval(spikes.detach())
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


def tfi(spikes: Tensor, max_range: float = 1.0, *, dtype: torch.dtype | None = None) -> Tensor:
    r"""Texture from interval: light as the inverse of the spike interval, at every frame.

    .. math:: R_n = \delta / \Psi_n

    Convention:
        Time is axis -3, intervals as in :func:`spike_interval`. A pixel that fires at every clock gives ``max_range``.
        For a scene simulated with gain alpha, divide the result by alpha.

        The gradient treats TFI as TFP over the interval between the two spikes:
        :math:`\partial R_n / \partial S_k = \delta / \Psi_n` for k in (last spike before n, first spike at or after
        n], 0 outside.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.
        max_range: :math:`\delta`, the value of a pixel that fires at every clock.
        dtype: dtype of the result; default: that of ``spikes`` if floating, else torch's default. ``torch.uint8`` is
            rounded to the nearest whole number and clamped to 0 .. 255, without a gradient.

    Returns:
        Raw intensities :math:`(*, T, H, W)`.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers, or ``dtype`` is neither floating nor uint8.
        ValueError: ``spikes`` has fewer than three dimensions or is empty, or ``max_range`` is not above 0.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 1]).reshape(4, 1, 1)
        >>> tfi(spikes).flatten().tolist()
        [0.5, 0.5, 0.5, 0.5]

    Reference:
        Dong et al., CVPR 2024, eq. (5); Zhu et al., ICME 2019.
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    check_positive("max_range", max_range)
    check_dtype(dtype, torch.uint8)
    return _Tfi.apply(spikes, float(max_range), dtype or default_float(spikes))


class Tfi(OptionsModule):
    r"""See the Convention block on :func:`tfi`.

    Shape:
        - Input: :math:`(*, T, H, W)`
        - Output: :math:`(*, T, H, W)`

    Example:
        >>> Tfi(max_range=255.0)(torch.ones(41, 2, 2)).max().item()
        255.0
    """

    def __init__(self, max_range: float = 1.0, *, dtype: torch.dtype | None = None) -> None:
        super().__init__()
        check_positive("max_range", max_range)
        check_dtype(dtype, torch.uint8)
        self.max_range, self.dtype = max_range, dtype

    def forward(self, spikes: Tensor) -> Tensor:  # noqa: D102
        return tfi(spikes, self.max_range, dtype=self.dtype)


def tfp(
    spikes: Tensor, window: int, max_range: float = 1.0, *, order: int = 1, dtype: torch.dtype | None = None
) -> Tensor:
    r"""Texture from playback: light as the mean number of spikes in a window around every frame.

    .. math:: R_n = \frac{\delta}{w} \sum_{|i - n| \le (w - 1) / 2} S_i

    Convention:
        Time is axis -3; the window is centred, and cut at the ends of the clip. A window longer than the clip is legal.
        Linear in the spikes, and differentiable as such; sums are computed in float32 or wider.

        An integrate-and-fire pixel is a delta-sigma modulator of first order: its rounding errors cancel over time. A
        repeated mean uses this. Three means over 13 frames see 37 frames, and have far less noise than one mean over
        41, and less motion blur, since frames far from n have small weights.

    Args:
        spikes: :math:`(*, T, H, W)`, zeros and ones, any real dtype.
        window: number of frames, odd.
        max_range: :math:`\delta`, the value of a pixel that fires at every clock.
        order: how many times the mean is taken; the result sees ``order * (window - 1) + 1`` frames.
        dtype: dtype of the result; default: that of ``spikes`` if floating, else torch's default. ``torch.uint8`` is
            rounded to the nearest whole number and clamped to 0 .. 255, without a gradient.

    Returns:
        Raw intensities :math:`(*, T, H, W)`.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers, or ``dtype`` is neither floating nor uint8.
        ValueError: ``spikes`` has fewer than three dimensions or is empty, ``window`` is even or below 1, ``order`` is
            below 1, or ``max_range`` is not above 0.

    Example:
        >>> spikes = torch.tensor([1, 0, 0, 1]).reshape(4, 1, 1)
        >>> tfp(spikes, 3).flatten().tolist()
        [0.5, 0.333..., 0.333..., 0.5]
        >>> tfp(torch.eye(5)[2].reshape(5, 1, 1), 3, order=2)[2].item()  # weights 1, 2, 3, 2, 1 of 9
        0.333...

    Reference:
        Dong et al., CVPR 2024, eq. (6); Zhu et al., ICME 2019. ``order``: the sinc^k filter of Candy, IEEE
        Transactions on Communications, 1986, which recommends one order more than that of the modulator.
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    window, order = check_window(window), check_whole("order", order)
    check_positive("max_range", max_range)
    check_dtype(dtype, torch.uint8)
    dtype = dtype or default_float(spikes)
    window = min(window, 2 * spikes.shape[-3] - 1)  # sees all frames from both ends
    between = torch.float64 if dtype == torch.float64 else torch.float32
    for _ in range(order - 1):
        spikes = _Tfp.apply(spikes, window, 1.0, between, False)
    return _Tfp.apply(spikes, window, float(max_range), dtype, False)


def check_window(window: int) -> int:
    """Return ``window`` as an int; raise a ValueError unless it is odd and >= 1."""
    window = check_whole("window", window)
    if window % 2 == 0:
        raise ValueError(f"window: expected an odd number of frames, got {window}")
    return window


class Tfp(OptionsModule):
    r"""See the Convention block on :func:`tfp`.

    Shape:
        - Input: :math:`(*, T, H, W)`
        - Output: :math:`(*, T, H, W)`

    Example:
        >>> Tfp(window=11)(torch.ones(41, 2, 2)).min().item()
        1.0
    """

    def __init__(
        self, window: int, max_range: float = 1.0, *, order: int = 1, dtype: torch.dtype | None = None
    ) -> None:
        super().__init__()
        check_window(window)
        check_whole("order", order)
        check_positive("max_range", max_range)
        check_dtype(dtype, torch.uint8)
        self.window, self.max_range, self.order, self.dtype = window, max_range, order, dtype

    def forward(self, spikes: Tensor) -> Tensor:  # noqa: D102
        return tfp(spikes, self.window, self.max_range, order=self.order, dtype=self.dtype)
