"""Demosaicing along motion: residual interpolation, corrected with samples from other times."""

from __future__ import annotations

import torch
from torch import Tensor

from spikekit.check import check_planes
from spikekit.color.cfa import Pattern, PatternModule, bayer_mask, bayer_pattern
from spikekit.color.residual_demosaic import guided_by_green, interpolate_green
from spikekit.warp.neighbors import finite
from spikekit.warp.warp import flow_warp

_SIGMA_SPACE = 0.5  # pixels: weight by distance from the trajectory
_SIGMA_RANGE = 0.5  # of white: weight by deviation from the estimate
_TAU = 5.0  # mosaics after which the weight drops to 1 / e


def demosaic_along_motion(raw: Tensor, flow: Tensor, pattern: Pattern = "RGGB") -> Tensor:
    r"""Demosaic the middle one of several mosaics, using samples of the others along the motion.

    The missing colours are first estimated in the middle mosaic, as by :func:`spikekit.demosaic_residual`. The estimate
    is then warped to every time t and compared with the samples r of that colour there. Finally it is corrected by a
    weighted mean of these deviations near the pixel's trajectory:

    .. math::
        \hat I(x) = E(x) + \frac{\sum_{t, k} w_{tk} \, (r_t(k) - E_t(k))}{\sum_{t, k} w_{tk}}, \quad
        w_{tk} = e^{-\frac{|k - x - o_t(x)|^2}{2 \sigma_s^2}} e^{-\frac{|t - j|}{\tau}}
        e^{-\frac{(r_t(k) - E_t(k))^2}{2 \sigma_r^2}}, \quad
        \sigma_s = \sigma_r = \frac{1}{2}, \; \tau = 5

    Green is corrected first, and then guides red and blue, which are corrected in the same way.

    Convention:
        The result is the picture at the middle time j, the mosaic T // 2; times are counted in mosaics. Flow in sensor
        pixels, order (x, y), backward sampling: pixel x of the picture is at x + o_t(x) in mosaic t, as returned by
        :func:`spikekit.linear_motion`. The samples k are those of the colour among the 3 x 3 pixels around that
        position; pixels outside the sensor are not used. E is warped to time t by the opposite flow, which assumes
        smooth motion; its errors and occlusions are suppressed by their deviation, white being 1. NaN flow counts as 0.
        Unlike in :func:`spikekit.demosaic_residual`, known values change, as other times contribute. Differentiable
        almost everywhere, in mosaics and flow. Computed in float32 or wider.

    Args:
        raw: mosaics :math:`(*, T, H, W)`, floating, white near 1, T odd, H and W at least 3.
        flow: :math:`(*, T, 2, H, W)`, from the middle to each time.
        pattern: Bayer phase, see :func:`spikekit.bayer_pattern`.

    Returns:
        The picture :math:`(*, 3, H, W)`, in the dtype of ``raw``.

    Raises:
        TypeError: ``raw`` or ``flow`` is not a floating-point tensor.
        ValueError: the sizes do not match, T is even, the mosaics are smaller than 3 x 3, or the pattern is unknown.

    Example:
        >>> raw, flow = torch.full((5, 4, 6), 0.25), torch.zeros(5, 2, 4, 6)
        >>> demosaic_along_motion(raw, flow).unique().tolist()
        [0.25]

    Reference:
        Follows the abstract of 3DRI (3D residual interpolation for spike camera demosaicing, ICIP 2022): missing pixels
        are estimated along motion trajectories, from residuals guided by green. Only the abstract is public. The
        weights are our own, so this is 3DRI-like, not 3DRI.
    """
    check_planes("raw", raw, 3, "(*, T, H, W)", floating=True)
    check_planes("flow", flow, 4, "(*, T, 2, H, W)", floating=True)
    frames, height, width = raw.shape[-3:]
    if height < 3 or width < 3 or frames % 2 == 0:
        raise ValueError(f"raw: expected (*, T, H, W) with T odd, of at least 3 x 3, got {tuple(raw.shape)}")
    expected = (*raw.shape[:-2], 2, height, width)
    if flow.shape != expected:
        raise ValueError(f"flow: expected {expected} for raw {tuple(raw.shape)}, got {tuple(flow.shape)}")
    pattern = bayer_pattern(pattern)
    wide = torch.promote_types(torch.promote_types(raw.dtype, flow.dtype), torch.float32)
    # contiguous, so that the order of sums is fixed
    known = raw.reshape(-1, frames, height, width).to(wide).contiguous()
    flow = finite(flow.reshape(-1, frames, 2, height, width).to(wide)).contiguous()
    index, near = _along(flow)

    def correct(estimate: Tensor, mask: Tensor) -> Tensor:
        moved = flow_warp(estimate[:, None, None].expand(-1, frames, -1, -1, -1), -flow).squeeze(2)
        deviation = (known - moved).flatten(2).gather(2, index.flatten(2)).reshape(index.shape)
        weight = near * mask.flatten()[index] * torch.exp(-deviation.square() / (2 * _SIGMA_RANGE**2))
        return estimate + (weight * deviation).sum((1, 2)) / weight.sum((1, 2)).clamp(min=torch.finfo(wide).tiny)

    middle = known[:, frames // 2]
    red, green, blue = bayer_mask(height, width, pattern, device=raw.device, dtype=torch.bool)
    greens = correct(interpolate_green(middle, green), green)
    reds, blues = (correct(guided_by_green(middle, greens, mask), mask) for mask in (red, blue))
    rgb = torch.stack([reds, greens, blues], dim=1)
    return rgb.to(raw.dtype).reshape(*raw.shape[:-3], 3, height, width)


def _along(flow: Tensor) -> tuple[Tensor, Tensor]:
    """Return flat indices of 3 x 3 pixels around trajectories, and weights by distance and time: (B, T, 9, H, W)."""
    _, frames, _, height, width = flow.shape
    x = torch.arange(width, device=flow.device) + flow[:, :, :1]
    y = torch.arange(height, device=flow.device)[:, None] + flow[:, :, 1:]
    step = torch.arange(9, device=flow.device)[:, None, None]
    column = x.detach().round().clamp(1, width - 2).long() + step % 3 - 1
    row = y.detach().round().clamp(1, height - 2).long() + step // 3 - 1
    square = (column - x).square() + (row - y).square()
    away = (torch.arange(frames, device=flow.device) - frames // 2).abs()[:, None, None, None]
    return row * width + column, torch.exp(-square / (2 * _SIGMA_SPACE**2) - away / _TAU)


class DemosaicAlongMotion(PatternModule):
    r"""See the Convention block on :func:`demosaic_along_motion`.

    Shape:
        - Input: mosaics :math:`(*, T, H, W)` and flow :math:`(*, T, 2, H, W)`
        - Output: :math:`(*, 3, H, W)`

    Example:
        >>> DemosaicAlongMotion("GBRG")(torch.rand(2, 5, 8, 8), torch.zeros(2, 5, 2, 8, 8)).shape
        torch.Size([2, 3, 8, 8])
    """

    def forward(self, raw: Tensor, flow: Tensor) -> Tensor:  # noqa: D102
        return demosaic_along_motion(raw, flow, self.pattern)
