"""Metrics as computed by the authors of CSCSR: on float colour pictures, without border crop, one value per picture."""

from __future__ import annotations

import torch
from torch import Tensor

from spikekit.check import check_planes

_BAND = 1 << 14  # pixels


def _pair(rgb: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    check_planes("rgb", rgb, 3, "(*, 3, H, W)", floating=True)
    check_planes("target", target, 3, "(*, 3, H, W)", floating=True)
    if rgb.shape != target.shape:
        raise ValueError(f"rgb, target: expected one size, got {tuple(rgb.shape)} and {tuple(target.shape)}")
    wide = torch.promote_types(torch.promote_types(rgb.dtype, target.dtype), torch.float32)
    return rgb.to(wide).clamp(0, 1), target.to(wide).clamp(0, 1)


def psnr(rgb: Tensor, target: Tensor) -> Tensor:
    r"""Peak signal-to-noise ratio of every picture, in dB.

    .. math:: -10 \log_{10} \frac{1}{3 H W} \sum_{C, x, y} (a - b)^2

    Convention:
        Both pictures are clamped to [0, 1] but not rounded. The mean square error is over all colours and pixels,
        without border crop. For several pictures, average the PSNR, not the errors. Computed in float32 or wider. The
        gradient is 0 for clamped values, and NaN if the two pictures are equal.

    Args:
        rgb: :math:`(*, 3, H, W)`, [0, 1].
        target: ground truth of the same size.

    Returns:
        PSNR in dB, of shape :math:`(*)`; infinite if the two pictures are equal.

    Raises:
        TypeError: ``rgb`` or ``target`` is not a floating-point tensor.
        ValueError: there are fewer than three dimensions, or the sizes differ.

    Example:
        >>> round(psnr(torch.full((3, 8, 8), 0.5), torch.full((3, 8, 8), 0.6)).item(), 3)
        20.0
    """
    rgb, target = _pair(rgb, target)
    return -10 * (rgb - target).square().mean(dim=(-3, -2, -1)).log10()


def ssim(rgb: Tensor, target: Tensor) -> Tensor:
    r"""Structural similarity of every picture.

    .. math::
        \frac{(2 \mu_a \mu_b + 0.01^2) (2 \sigma_{ab} + 0.03^2)}
        {(\mu_a^2 + \mu_b^2 + 0.01^2) (\sigma_a^2 + \sigma_b^2 + 0.03^2)}

    Convention:
        Like ``skimage.metrics.structural_similarity`` with its defaults and ``channel_axis``: 7 x 7 uniform window,
        sample covariance, only windows inside the picture, mean over pixels and colours. Both pictures are clamped to
        [0, 1], and clamped values have gradient 0. Computed in float64.

    Args:
        rgb: :math:`(*, 3, H, W)`, [0, 1], H and W at least 7.
        target: ground truth of the same size.

    Returns:
        SSIM, of shape :math:`(*)`, float32 or wider.

    Raises:
        TypeError: ``rgb`` or ``target`` is not a floating-point tensor.
        ValueError: there are fewer than three dimensions, the sizes differ, or they are below 7 x 7.

    Example:
        >>> picture = torch.rand(2, 3, 16, 16)
        >>> ssim(picture, picture).tolist()
        [1.0, 1.0]

    Reference:
        Wang, Bovik, Sheikh and Simoncelli, Image quality assessment: from error visibility to structural similarity,
        IEEE Transactions on Image Processing, 2004.
    """
    rgb, target = _pair(rgb, target)
    if rgb.shape[-2] < 7 or rgb.shape[-1] < 7:
        raise ValueError(f"rgb: expected at least 7 x 7 pixels, got {tuple(rgb.shape)}")
    planes = (picture.flatten(0, -3).unbind() for picture in (rgb, target))
    each = [_similarity(a, b) for a, b in zip(*planes, strict=True)]
    similar = torch.stack(each) if each else rgb[..., 0, 0]  # of no pictures
    return similar.reshape(rgb.shape[:-2]).mean(dim=-1).to(rgb.dtype)


def _similarity(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean SSIM of two planes, in bands of rows that fit the cache."""
    rows = max(1, _BAND // a.shape[-1])
    bands = (slice(top, top + rows + 6) for top in range(0, len(a) - 6, rows))
    return torch.cat([_of_windows(a[band].double(), b[band].double()) for band in bands]).mean()


def _of_windows(a: Tensor, b: Tensor) -> Tensor:
    """Return the SSIM of every window; numerator and denominator are multiples of those in the formula."""
    sum_a, sum_b, both = _windows(a), _windows(b), _windows(a * b)
    squares = _windows(torch.addcmul(a * a, b, b))
    c1, c2 = 49**2 * 0.01**2, 49 * 48 * 0.03**2  # sample covariance: 48 in place of 49
    product, norm = sum_a * sum_b + c1 / 2, torch.addcmul(c1 + sum_a * sum_a, sum_b, sum_b)
    numerator = product * (49 * both + (c1 / 2 + c2 / 2) - product)
    return 4 * (numerator / (norm * (49 * squares + (c1 + c2) - norm)))


def _windows(plane: Tensor) -> Tensor:
    """Return the sums of all 7 x 7 windows inside the plane, from sums of 2 and 4 along each axis."""
    for dim in (-2, -1):
        length = plane.shape[dim]
        two = plane.narrow(dim, 0, length - 1) + plane.narrow(dim, 1, length - 1)
        four = two.narrow(dim, 0, length - 3) + two.narrow(dim, 2, length - 3)
        windows = length - 6
        plane = (four.narrow(dim, 0, windows) + two.narrow(dim, 4, windows)).add_(plane.narrow(dim, 6, windows))
    return plane
