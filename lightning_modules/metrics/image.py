"""Metrics of pictures: PSNR, SSIM, and LPIPS where its weights are at hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from lightning_modules.metrics.lpips import find_weights, lpips
from spikekit import psnr, ssim


class Measure(NamedTuple):
    """A measure of pictures.

    Args:
        name: column of a CSV.
        heading: of a table.
        digits: how many a table shows.
        of: from pictures and the truth, :math:`(B, 3, H, W)` each, to a value for every picture, :math:`(B)`.
    """

    name: str
    heading: str
    digits: int
    of: Callable[[Tensor, Tensor], Tensor]


def measures() -> list[Measure]:
    """Return the measures that are available here.

    Example:
        >>> [measure.name for measure in measures()][:2]
        ['psnr', 'ssim']
    """
    found = [Measure("psnr", "PSNR (dB)", 2, psnr), Measure("ssim", "SSIM", 4, ssim)]
    return found if why_no_lpips() else [*found, Measure("lpips", "LPIPS", 4, lpips)]


def score(rgb: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """Return all measures of pictures (B, ..., 3, H, W) by name: a value (B) each, the mean of those of a film."""
    flat, known = (planes.reshape(-1, *planes.shape[-3:]) for planes in (rgb, truth))
    return {measure.name: measure.of(flat, known).reshape(len(truth), -1).mean(dim=1) for measure in measures()}


def why_no_lpips() -> str | None:
    """Return in one line what LPIPS lacks here, or None."""
    try:
        find_weights()
    except FileNotFoundError as error:
        return f"LPIPS not measured: {error}"
    return None
