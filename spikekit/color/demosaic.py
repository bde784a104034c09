"""Demosaicing: from a mosaic to a colour picture of the same size."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from kornia.color import CFA
from torch import Tensor

from spikekit.check import check_planes
from spikekit.color.cfa import PatternModule, bayer_mask, bayer_sites, count_colors

# Malvar, He and Cutler (2004), Fig. 2, in eighths: the estimate at the centre.
_GREEN = [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]
_SAME_ROW = [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]]
_SAME_COLUMN = [list(row) for row in zip(*_SAME_ROW, strict=True)]
_DIAGONAL = [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]]


def demosaic(raw: Tensor, pattern: str | CFA = "RGGB") -> Tensor:
    r"""Fill in the two missing colours of every pixel with Malvar, He and Cutler's 5 x 5 linear filters.

    Green at a red pixel, for one, is the mean of the green neighbours and half of what red differs from its own
    neighbours by:

    .. math::
        \hat g(x, y) = \frac{1}{4} \sum_{|a| + |b| = 1} g(x + a, y + b)
        + \frac{1}{2} \Bigl(r(x, y) - \frac{1}{4} \sum_{|a| + |b| = 1} r(x + 2 a, y + 2 b)\Bigr)

    Red and blue are found in the same way, with a gain of 5/8 at green pixels and of 3/4 at each other's.

    Convention:
        Known values are kept. Linear in the mosaic, and differentiable as such. Nothing is clamped: of a mosaic in
        [0, 1] the result is in [-3/4, 7/4]. Borders are mirrored without repeating the outermost pixel, which keeps
        the Bayer phase. Computed in float32 or wider.

    Args:
        raw: mosaic :math:`(*, H, W)`, floating, H and W at least 3; odd sizes are legal.
        pattern: Bayer phase, see :func:`spikekit.bayer_pattern`; of ``"grey"`` there is nothing to fill in.

    Returns:
        The picture :math:`(*, 3, H, W)`, or :math:`(*, 1, H, W)` of a grey sensor, in the dtype of ``raw``.

    Raises:
        TypeError: ``raw`` is not a floating-point tensor.
        ValueError: fewer than two dimensions, smaller than 3 x 3, or an unknown pattern.

    Example:
        >>> demosaic(torch.full((4, 6), 0.25)).unique().tolist()
        [0.25]

    Reference:
        Malvar, He and Cutler, High-quality linear interpolation for demosaicing of Bayer-patterned color images,
        ICASSP 2004. kornia's ``raw_to_rgb`` interpolates bilinearly.
    """
    known = wide_mosaics(raw)[:, None]
    if count_colors(pattern) == 1:
        return raw.unsqueeze(-3).clone()
    height, width = raw.shape[-2:]
    filters = known.new_tensor([_GREEN, _SAME_ROW, _SAME_COLUMN, _DIAGONAL])[:, None] / 8
    with torch.autocast(raw.device.type, enabled=False):
        filtered = F.conv2d(F.pad(known, (2, 2, 2, 2), "reflect"), filters)
    green, same_row, same_column, diagonal = filtered.unbind(1)
    known = known[:, 0]

    red, _, blue = bayer_mask(height, width, pattern, device=raw.device, dtype=torch.bool)
    (_, red_row, _), *_ = bayer_sites(pattern)
    in_red_row = (torch.arange(height, device=raw.device) % 2 == red_row)[:, None]
    reds = torch.where(red, known, torch.where(blue, diagonal, torch.where(in_red_row, same_row, same_column)))
    blues = torch.where(blue, known, torch.where(red, diagonal, torch.where(in_red_row, same_column, same_row)))
    greens = torch.where(red | blue, green, known)
    rgb = torch.stack([reds, greens, blues], dim=1)
    return rgb.to(raw.dtype).reshape(*raw.shape[:-2], 3, height, width)


def wide_mosaics(raw: Tensor) -> Tensor:
    """Check mosaics and return them as (B, H, W), float32 or wider.

    Args:
        raw: mosaics (*, H, W).

    Raises:
        TypeError: not a floating-point tensor.
        ValueError: fewer than two dimensions, or smaller than 3 x 3.
    """
    check_planes("raw", raw, 2, "(*, H, W)", floating=True)
    if min(raw.shape[-2:]) < 3:
        raise ValueError(f"raw: expected (*, H, W) of at least 3 x 3, got {tuple(raw.shape)}")
    return raw.reshape(-1, *raw.shape[-2:]).to(torch.promote_types(raw.dtype, torch.float32))


class Demosaic(PatternModule):
    r"""See the Convention block on :func:`demosaic`.

    Shape:
        - Input: :math:`(*, H, W)`
        - Output: :math:`(*, 3, H, W)`

    Example:
        >>> Demosaic("GBRG")(torch.rand(2, 11, 8, 8)).shape
        torch.Size([2, 11, 3, 8, 8])
    """

    def forward(self, raw: Tensor) -> Tensor:  # noqa: D102
        return demosaic(raw, self.pattern)
