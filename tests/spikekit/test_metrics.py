"""The metrics against scikit-image."""

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch.autograd import gradcheck

from spikekit import psnr, ssim


def skimage_psnr(rgb, target):
    return peak_signal_noise_ratio(target.numpy(), rgb.numpy(), data_range=1)


def skimage_ssim(rgb, target):
    return structural_similarity(rgb.numpy(), target.numpy(), channel_axis=0, data_range=1)


JUDGES = pytest.mark.parametrize(("metric", "judge"), [(psnr, skimage_psnr), (ssim, skimage_ssim)])


def pair(*lead, size=(9, 12)):
    target = torch.rand(*lead, 3, *size, dtype=torch.float64)
    return (target + 0.1 * torch.randn_like(target)).clamp(0, 1), target


@JUDGES
@pytest.mark.parametrize(("lead", "size"), [((), (7, 7)), ((3,), (9, 12)), ((2, 3), (20, 8)), ((0,), (7, 7))])
def test_one_value_per_picture(metric, judge, lead, size):
    rgb, target = pair(*lead, size=size)
    figures = metric(rgb, target)
    assert figures.shape == lead
    each = [judge(a, b) for a, b in zip(rgb.reshape(-1, 3, *size), target.reshape(-1, 3, *size), strict=True)]
    assert figures.flatten().tolist() == pytest.approx(each, rel=1e-10)
    assert metric(rgb.float(), target.float()).flatten().tolist() == pytest.approx(each, rel=1e-5)


@JUDGES
def test_both_pictures_are_clamped(metric, judge):
    rgb, target = torch.randn(2, 3, 9, 12, dtype=torch.float64)
    assert metric(rgb, target).item() == pytest.approx(judge(rgb.clamp(0, 1), target.clamp(0, 1)), rel=1e-10)


def test_ssim_of_flat_bright_pictures():
    """Variances cancel here; float32 would lose them."""
    rgb, target = (0.9 + 1e-3 * picture.float() for picture in pair())
    assert ssim(rgb, target).item() == pytest.approx(skimage_ssim(rgb.double(), target.double()), rel=1e-5)


def test_gradients_equal_finite_differences():
    rgb, target = pair(size=(7, 8))
    rgb = (0.1 + 0.8 * rgb).requires_grad_()
    assert gradcheck(lambda x: psnr(x, target), rgb)
    assert gradcheck(lambda x: ssim(x, target), rgb)


@pytest.mark.parametrize("metric", [psnr, ssim])
@pytest.mark.parametrize(
    ("error", "rgb", "target"),
    [
        (ValueError, torch.rand(3, 8, 8), torch.rand(3, 8, 9)),
        (ValueError, torch.rand(1, 3, 8, 8), torch.rand(3, 8, 8)),
        (ValueError, torch.rand(8, 8), torch.rand(8, 8)),
        (TypeError, torch.ones(3, 8, 8, dtype=torch.uint8), torch.ones(3, 8, 8, dtype=torch.uint8)),
    ],
)
def test_invalid_pictures_are_rejected(metric, error, rgb, target):
    with pytest.raises(error):
        metric(rgb, target)


def test_ssim_needs_a_window():
    with pytest.raises(ValueError, match="7 x 7"):
        ssim(torch.rand(3, 6, 9), torch.rand(3, 6, 9))
