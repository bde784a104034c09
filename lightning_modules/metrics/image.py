"""Metrics of pictures: PSNR, SSIM, and LPIPS where its weights are installed."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from spikekit import psnr, ssim

#: the file in which torchvision keeps the weights of AlexNet
_ALEXNET = "alexnet-owt-7be5be79.pth"
#: pixels along a side, below which nothing is left of a picture in AlexNet
_LEAST = 63


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


def why_no_lpips() -> str | None:
    """Return in one line what LPIPS lacks here, or None. Nothing is downloaded unasked."""
    weights = Path(torch.hub.get_dir()) / "checkpoints" / _ALEXNET
    if find_spec("torchvision") is None:
        return "LPIPS not measured: expected torchvision, which is not installed"
    if not weights.is_file():
        fetch = "python -c 'import torchvision; torchvision.models.alexnet(weights=\"DEFAULT\")' fetches it"
        return f"LPIPS not measured: expected the weights of AlexNet in {weights}, got none; {fetch}"
    return None


def lpips(rgb: Tensor, truth: Tensor) -> Tensor:
    """Learned perceptual image patch similarity with AlexNet's features, by torchmetrics; lower is better.

    In the convention of the authors of CSCSR, whose programs give the metric pictures of 0 .. 1 as they are. LPIPS was
    trained on pictures brought to -1 .. 1, which have other values. No library ships AlexNet's weights;
    :func:`why_no_lpips` says how to fetch them.

    Args:
        rgb: :math:`(B, 3, H, W)`, cut to 0 .. 1.
        truth: likewise.

    Returns:
        A value for every picture, :math:`(B)`; NaN for pictures below 63 pixels a side, of which AlexNet sees nothing.

    Reference:
        Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, CVPR 2018.
    """
    if min(rgb.shape[-2:]) < _LEAST:
        return rgb.new_full(rgb.shape[:1], torch.nan)
    metric = _metric(rgb.device)
    pictures = zip(rgb.float().clamp(0, 1).split(1), truth.float().clamp(0, 1).split(1), strict=True)
    return torch.stack([metric(*pair) for pair in pictures])


@lru_cache(maxsize=1)
def _metric(device: torch.device) -> Callable[[Tensor, Tensor], Tensor]:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity("alex").to(device)
