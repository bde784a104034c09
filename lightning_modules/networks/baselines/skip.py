"""A skip from the decoded picture, for networks that were published without one and are trained for a short time."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightning_modules.networks.baselines.pictures import enlarge_picture
from spikekit import demosaic_residual


def begin_at_zero(*layers: nn.Conv2d) -> None:
    """Initialise convolutions with zeros, so that training starts from what their result is added to."""
    for layer in layers:
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)


@torch.no_grad()
def enlarged_raw(raw: Tensor, pattern: str | None, scale: int) -> Tensor:
    """Demosaic by residual interpolation, and enlarge bicubically.

    Args:
        raw: (B, H, W).
        pattern: Bayer phase; None where all pixels see one colour, which leaves nothing to demosaic.
        scale: enlargement s.

    Returns:
        (B, 3, s H, s W), or (B, 1, s H, s W) of one colour.
    """
    picture = raw.unsqueeze(1) if pattern is None else demosaic_residual(raw, pattern)
    return enlarge_picture(picture, scale)
