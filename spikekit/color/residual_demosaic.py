"""Demosaicing by residual interpolation: one colour predicts another, and the residual is interpolated."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.color.cfa import Pattern, PatternModule, bayer_mask, count_colors
from spikekit.color.demosaic import wide_mosaics

_RADIUS = 5  # radius of the guided filter
_FLAT = 1e-5  # lower bound of a guide's variance; white is 1
_STEADY = 1e-6  # lower bound of the squared change along a direction
_FADE = [math.exp(-(k**2) / 8) for k in range(5)]  # half of a Gaussian of nine taps, sigma 2
_BORDER = 18  # receptive radius, 17, rounded up to keep the Bayer phase


def demosaic_residual(raw: Tensor, pattern: Pattern = "RGGB") -> Tensor:
    r"""Interpolate the two missing colours of every pixel by residual interpolation, guided by green.

    In every window a guide I predicts a colour p by a line, fitted to the pixels k where p is known. Only the residual
    is interpolated, which is smoother than the colour itself:

    .. math::
        \hat p = \bar a I + \bar b + \mathcal{L}(p - \bar a I - \bar b), \quad
        a = \frac{\operatorname{cov}_k(I, p)}{\operatorname{var}_k(I)}, \quad b = \bar p - a \bar I

    Green is interpolated first. Along rows and columns, green and the other colour of the line predict each other over
    11 pixels. Their difference is smoothed on four sides by half a Gaussian of nine taps, and the sides are weighted by
    the inverse square of its change over 5 x 5 pixels. Green then guides red and blue, in windows of 11 x 11 pixels.

    Convention:
        Known values are kept. Not linear: fitted lines and weights depend on the mosaic, with white near 1;
        differentiable almost everywhere. Nothing is clamped. Borders are mirrored without repeating the outermost
        pixel, which keeps the Bayer phase. Computed in float32 or wider.

    Args:
        raw: mosaic :math:`(*, H, W)`, floating, H and W at least 3; odd sizes are legal.
        pattern: Bayer phase, see :func:`spikekit.bayer_pattern`; ``"grey"`` only adds an axis.

    Returns:
        The picture :math:`(*, 3, H, W)`, or :math:`(*, 1, H, W)` for a grey sensor, in the dtype of ``raw``.

    Raises:
        TypeError: ``raw`` is not a floating-point tensor.
        ValueError: ``raw`` has fewer than two dimensions or is smaller than 3 x 3, or the pattern is unknown.

    Example:
        >>> demosaic_residual(torch.full((4, 6), 0.25)).unique().tolist()
        [0.25]

    Reference:
        Kiku, Monno, Tanaka and Okutomi, Residual interpolation for color image demosaicking, ICIP 2013. Sigma = 2, the
        two lower bounds, and the absence of clamping are our own.
    """
    known = wide_mosaics(raw)
    if count_colors(pattern) == 1:
        return raw.unsqueeze(-3).clone()
    height, width = raw.shape[-2:]
    red, green, blue = bayer_mask(height, width, pattern, device=raw.device, dtype=torch.bool)
    greens = interpolate_green(known, green)
    rgb = torch.stack([guided_by_green(known, greens, red), greens, guided_by_green(known, greens, blue)], dim=1)
    return rgb.to(raw.dtype).reshape(*raw.shape[:-2], 3, height, width)


class DemosaicResidual(PatternModule):
    r"""See the Convention block on :func:`demosaic_residual`.

    Shape:
        - Input: :math:`(*, H, W)`
        - Output: :math:`(*, 3, H, W)`

    Example:
        >>> DemosaicResidual("GBRG")(torch.rand(2, 11, 8, 8)).shape
        torch.Size([2, 11, 3, 8, 8])
    """

    def forward(self, raw: Tensor) -> Tensor:  # noqa: D102
        return demosaic_residual(raw, self.pattern)


def interpolate_green(known: Tensor, green: Tensor) -> Tensor:
    """Interpolate green in mosaics (B, H, W), given the mask (H, W) of green pixels."""
    known, green = _with_border(known), _with_border(green)
    across = _green_minus_other(known, green)
    down = _green_minus_other(known.mT, green.mT).mT
    total, weights = torch.zeros_like(known), torch.zeros_like(known)
    for difference, axis in ((across, -1), (down, -2)):
        change = (_further(difference, 1, axis) - _further(difference, -1, axis)).abs()
        change = _sums(change, 2, 2)
        for side in (-1, 1):
            weight = 1 / (_further(change, 2 * side, axis).square() + _STEADY)
            taps = [tap * _further(difference, k * side, axis) for k, tap in enumerate(_FADE)]
            total = total + weight * torch.stack(taps).sum(0) / sum(_FADE)
            weights = weights + weight
    return _without_border(torch.where(green, known, known + total / weights))


def guided_by_green(known: Tensor, greens: Tensor, mask: Tensor) -> Tensor:
    """Interpolate red or blue in mosaics (B, H, W), given green everywhere and the mask (H, W) of the colour."""
    known, greens, mask = _with_border(known), _with_border(greens), _with_border(mask)
    filled = _predict(greens, known, mask, _RADIUS, lambda residual: _between(_between(residual, -1), -2))
    return _without_border(torch.where(mask, known, filled))


def _green_minus_other(known: Tensor, green: Tensor) -> Tensor:
    """Return, at every pixel, green minus the other colour of the row."""
    beside = (_further(known, 1, -1) + _further(known, -1, -1)) / 2
    greens = _predict(torch.where(green, beside, known), known, green, 0, lambda residual: _between(residual, -1))
    others = _predict(torch.where(green, known, beside), known, ~green, 0, lambda residual: _between(residual, -1))
    return torch.where(green, known - others, greens - known)


def _predict(guide: Tensor, known: Tensor, mask: Tensor, rows: int, interpolate: Callable[[Tensor], Tensor]) -> Tensor:
    """Predict a colour by a guided filter with windows of radius ``rows`` and ``_RADIUS``, and add the residual."""

    def mean(planes: Tensor) -> Tensor:
        return _sums(torch.where(mask, planes, 0), rows, _RADIUS) / count

    count = _sums(mask.to(guide)[None], rows, _RADIUS)
    mean_guide, mean_known = mean(guide), mean(known)
    covariance = mean(guide * known) - mean_guide * mean_known
    slope = covariance / (mean(guide.square()) - mean_guide.square()).clamp(min=_FLAT)
    offset = mean_known - slope * mean_guide
    windows = _sums(torch.ones_like(count), rows, _RADIUS)
    predicted = (_sums(slope, rows, _RADIUS) * guide + _sums(offset, rows, _RADIUS)) / windows
    return predicted + interpolate(torch.where(mask, known - predicted, 0))


def _between(planes: Tensor, axis: int) -> Tensor:
    """Fill every other pixel of a line, which is 0, with the mean of its neighbours."""
    return planes + (_further(planes, 1, axis) + _further(planes, -1, axis)) / 2


def _further(planes: Tensor, by: int, axis: int) -> Tensor:
    """Shift planes by ``by`` pixels along an axis; wrapping affects only the border."""
    return planes.roll(-by, axis)


def _sums(planes: Tensor, rows: int, columns: int) -> Tensor:
    """Return the sums of (B, H, W) over windows of radius ``rows`` and ``columns``, cut at the edges."""
    for half in ((rows, 0), (0, columns)):
        if any(half):
            kernel = 2 * half[0] + 1, 2 * half[1] + 1
            # mean times size, as ONNX ignores divisor_override
            planes = F.avg_pool2d(planes.unsqueeze(1), kernel, 1, half).squeeze(1) * max(kernel)
    return planes


def _with_border(planes: Tensor) -> Tensor:
    for axis in (-2, -1):
        length = planes.shape[axis]
        at = torch.arange(-_BORDER, length + _BORDER, device=planes.device)
        at = at.remainder(torch.full((1,), 2 * length - 2, device=planes.device))  # ONNX needs a tensor
        planes = planes.index_select(axis, torch.minimum(at, 2 * length - 2 - at))
    return planes


def _without_border(planes: Tensor) -> Tensor:
    return planes[..., _BORDER:-_BORDER, _BORDER:-_BORDER]
