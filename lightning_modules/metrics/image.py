"""Metrics for pictures: PSNR, SSIM, and LPIPS if its weights are installed; blur and noise without ground truth."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.metrics.lpips import find_weights, lpips
from spikekit import psnr, ssim
from spikekit.calibration.gain_spread import SECOND_DIFFERENCE


class Measure(NamedTuple):
    """Metric for pictures: column in CSV files, heading and decimal places in tables.

    ``of`` maps pictures and ground truth, :math:`(B, 3, H, W)`, to a value per picture, :math:`(B)`; without ground
    truth, it maps grey pictures, :math:`(B, 1, H, W)`.
    """

    name: str
    heading: str
    digits: int
    of: Callable[..., Tensor]


def measures(truth: bool = True) -> list[Measure]:
    """Return the available metrics, with ground truth or without.

    Example:
        >>> [measure.name for measure in measures()][:2]
        ['psnr', 'ssim']
    """
    if not truth:
        return [Measure("blur", "blur", 3, _blur), Measure("noise", "noise", 4, _noise)]
    found = [Measure("psnr", "PSNR (dB)", 2, psnr), Measure("ssim", "SSIM", 4, ssim)]
    return found if why_no_lpips() else [*found, Measure("lpips", "LPIPS", 4, lpips)]


def score(rgb: Tensor, truth: Tensor | None) -> dict[str, Tensor]:
    """Return all metrics of pictures (B, ..., 3, H, W) by name, as values (B), averaged over the pictures of a film."""
    pair = (rgb.clamp(0, 1).mean(dim=-3, keepdim=True),) if truth is None else (rgb, truth)
    flat = [planes.reshape(-1, *planes.shape[-3:]) for planes in pair]
    return {one.name: one.of(*flat).reshape(len(rgb), -1).mean(dim=1) for one in measures(truth is not None)}


def _blur(grey: Tensor) -> Tensor:
    """Return the blur of Crété et al. 2007, from 0 for sharp to 1."""
    from skimage.measure import blur_effect

    return torch.tensor([blur_effect(picture.numpy()) for picture in grey[:, 0].float().cpu()])


def _noise(grey: Tensor) -> Tensor:
    """Return the standard deviation of white noise, white being 1, after Immerkaer 1996 but from the median."""
    noise = F.conv2d(grey.float(), SECOND_DIFFERENCE[None, None].to(grey.device))
    return noise.abs().flatten(1).median(dim=1).values / 0.6745


def why_no_lpips() -> str | None:
    """Return a one-line reason why LPIPS is not available, or None if it is."""
    try:
        find_weights()
    except FileNotFoundError as error:
        return f"LPIPS not measured: {error}"
    return None
