"""Filters of planes."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor


def separable_filter(planes: Tensor, weights: Sequence[float], border: str = "reflect") -> Tensor:
    """Filter planes along both axes by the same short kernel.

    As :func:`kornia.filters.filter2d_separable`, whose convolutions take about ten times as long on a CPU.

    Args:
        planes: (B, C, H, W), floating.
        weights: an odd number of weights.
        border: mode of :func:`torch.nn.functional.pad`.

    Example:
        >>> import torch
        >>> separable_filter(torch.tensor([[[[0.0, 8, 0], [0, 0, 0], [0, 0, 0]]]]), (0.25, 0.5, 0.25), "replicate")
        tensor([[[[1.5000, 3.0000, 1.5000],
                  [0.5000, 1.0000, 0.5000],
                  [0.0000, 0.0000, 0.0000]]]])
    """
    half = len(weights) // 2
    for axis, padding in ((-1, (half, half, 0, 0)), (-2, (0, 0, half, half))):
        around, length = F.pad(planes, padding, border), planes.shape[axis]
        planes = around.narrow(axis, 0, length) * weights[0]
        for n, weight in enumerate(weights[1:], 1):
            planes = planes.add_(around.narrow(axis, n, length), alpha=weight)
    return planes
