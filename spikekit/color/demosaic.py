"""Demosaicing by linear filters."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.check import check_planes
from spikekit.color.cfa import Pattern, PatternModule, bayer_sites, count_colors


def demosaic(raw: Tensor, pattern: Pattern = "RGGB") -> Tensor:
    r"""Interpolate the two missing colours of every pixel with the 5 x 5 linear filters of Malvar, He and Cutler.

    For example, green at a red pixel is the mean of its green neighbours, plus half the difference between the red
    pixel and the mean of its red neighbours:

    .. math::
        \hat g(x, y) = \frac{1}{4} \sum_{|a| + |b| = 1} g(x + a, y + b)
        + \frac{1}{2} \Bigl(r(x, y) - \frac{1}{4} \sum_{|a| + |b| = 1} r(x + 2 a, y + 2 b)\Bigr)

    Red and blue are interpolated in the same way, with a gain of 5/8 at green pixels and 3/4 at blue and red ones.

    Convention:
        Known values are kept. Linear in the mosaic, and differentiable as such. Nothing is clamped: for a mosaic in
        [0, 1] the result is in [-3/4, 7/4]. Borders are mirrored without repeating the outermost pixel, which keeps
        the Bayer phase. Computed in float32 or wider.

    Args:
        raw: mosaic :math:`(*, H, W)`, floating, H and W at least 3; odd sizes are legal.
        pattern: Bayer phase, see :func:`spikekit.bayer_pattern`; ``"grey"`` only adds an axis.

    Returns:
        The picture :math:`(*, 3, H, W)`, or :math:`(*, 1, H, W)` for a grey sensor, in the dtype of ``raw``.

    Raises:
        TypeError: ``raw`` is not a floating-point tensor.
        ValueError: ``raw`` has fewer than two dimensions or is smaller than 3 x 3, or the pattern is unknown.

    Example:
        >>> demosaic(torch.full((4, 6), 0.25)).unique().tolist()
        [0.25]

    Reference:
        Malvar, He and Cutler, High-quality linear interpolation for demosaicing of Bayer-patterned color images,
        ICASSP 2004. kornia's ``raw_to_rgb`` interpolates bilinearly.
    """
    known = wide_mosaics(raw)
    if count_colors(pattern) == 1:
        return raw.unsqueeze(-3).clone()
    height, width = raw.shape[-2:]
    mirrored = F.pad(known.unsqueeze(1), (2, 2, 2, 2), "reflect").squeeze(1)
    padded = F.pad(mirrored, (0, width % 2, 0, height % 2))
    phases = padded.unflatten(2, (-1, 2)).unflatten(1, (-1, 2)).permute(0, 2, 4, 1, 3).flatten(1, 2).contiguous()
    cells = [[phases] * 4 for _ in range(3)]
    (_, red_row, _), *_ = bayer_sites(pattern)
    for colour, row, column in bayer_sites(pattern):
        own, row_colour, column_colour, opposite = _fill_in(phases, row, column, green=colour == 1)
        red, blue = (row_colour, column_colour) if row == red_row else (column_colour, row_colour)
        found = (red, own, blue) if colour == 1 else (own, row_colour, opposite)[:: 1 - colour]
        for cell, value in zip(cells, found, strict=True):
            cell[2 * row + column] = value
    rgb = torch.stack([torch.stack(cell, dim=1) for cell in cells], dim=1).unflatten(2, (2, 2))
    rgb = rgb.permute(0, 1, 4, 2, 5, 3).flatten(4, 5).flatten(2, 3)
    return rgb[..., :height, :width].to(raw.dtype).reshape(*raw.shape[:-2], 3, height, width)


def _fill_in(phases: Tensor, row: int, column: int, *, green: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Interpolate the colours at one site of all cells, by the filters of Malvar, He and Cutler (2004), Fig. 2.

    Takes the four phases (B, 4, h + 2, w + 2) of mosaics padded by two pixels. Returns the site's own colour, the
    colours of its row and its column (both green unless the site is green), and the colour of the diagonals.
    """
    height, width = phases.shape[-2] - 2, phases.shape[-1] - 2

    def at(down: int, right: int) -> Tensor:
        y, x = row + 2 + down, column + 2 + right
        return phases[:, 2 * (y % 2) + x % 2, y // 2 : y // 2 + height, x // 2 : x // 2 + width]

    own, sides, ends = at(0, 0), at(0, -1) + at(0, 1), at(-1, 0) + at(1, 0)
    far_sides, far_ends = at(0, -2) + at(0, 2), at(-2, 0) + at(2, 0)
    corners = at(-1, -1) + at(-1, 1) + at(1, -1) + at(1, 1)
    if green:
        same = torch.sub(own * 0.625, corners, alpha=0.125)
        of_row = same.add(sides, alpha=0.5).sub(far_sides, alpha=0.125).add(far_ends, alpha=0.0625)
        of_column = same.add(ends, alpha=0.5).sub(far_ends, alpha=0.125).add(far_sides, alpha=0.0625)
        return own, of_row, of_column, own
    far = far_sides + far_ends
    near = (own * 0.5).add(sides + ends, alpha=0.25).sub(far, alpha=0.125)
    return own, near, near, (own * 0.75).add(corners, alpha=0.25).sub(far, alpha=0.1875)


def wide_mosaics(raw: Tensor) -> Tensor:
    """Return mosaics (*, H, W), checked, as (B, H, W) in float32 or wider."""
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
