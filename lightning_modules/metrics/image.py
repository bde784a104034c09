"""Metrics for pictures: PSNR, SSIM, and LPIPS if its weights are installed."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from lightning_modules.metrics.lpips import find_weights, lpips
from spikekit import psnr, ssim


class Measure(NamedTuple):
    """Metric for pictures: column in CSV files, heading and decimal places in tables.

    ``of`` maps pictures and ground truth, :math:`(B, 3, H, W)`, to a value per picture, :math:`(B)`.
    """

    name: str
    heading: str
    digits: int
    of: Callable[[Tensor, Tensor], Tensor]


def measures() -> list[Measure]:
    """Return the available metrics.

    Example:
        >>> [measure.name for measure in measures()][:2]
        ['psnr', 'ssim']
    """
    found = [Measure("psnr", "PSNR (dB)", 2, psnr), Measure("ssim", "SSIM", 4, ssim)]
    return found if why_no_lpips() else [*found, Measure("lpips", "LPIPS", 4, lpips)]


def score(rgb: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """Return all metrics of pictures (B, ..., 3, H, W) by name, as values (B), averaged over the pictures of a film."""
    flat, known = (planes.reshape(-1, *planes.shape[-3:]) for planes in (rgb, truth))
    return {measure.name: measure.of(flat, known).reshape(len(truth), -1).mean(dim=1) for measure in measures()}


def why_no_lpips() -> str | None:
    """Return a one-line reason why LPIPS is not available, or None if it is."""
    try:
        find_weights()
    except FileNotFoundError as error:
        return f"LPIPS not measured: {error}"
    return None
