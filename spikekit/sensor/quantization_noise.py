"""Quantisation noise: the variance of weighted sums of spikes under constant light."""

from __future__ import annotations

import torch
from torch import Tensor


def flicker(weights: Tensor, light: Tensor) -> Tensor:
    r"""Variance of weighted sums of a pixel's spikes in constant light, over all initial charges.

    An ideal pixel fires where its charge passes a whole number: for a share r of all phases, r being the light, and
    d frames later for as many, moved by d r around the circle. The share that is in both, less :math:`r^2`, is the
    covariance of two spikes d frames apart.

    Args:
        weights: (K, N), K sums over N frames.
        light: (L), in thresholds a frame, from 0 to 1.

    Returns:
        (K, L), float32.

    Example:
        >>> flicker(torch.ones(1, 1), torch.tensor([0.0, 0.25, 0.5]))  # one spike, of such a probability
        tensor([[0.0000, 0.1875, 0.2500]])
    """
    weights, light = weights.double(), light.double()
    frames = weights.shape[-1]
    pairs = [(2 if apart else 1) * weights[:, : frames - apart] * weights[:, apart:] for apart in range(frames)]
    moved = torch.arange(frames, dtype=torch.float64).unsqueeze(1) * light % 1
    both = (light - moved).clamp(min=0) + (moved + light - 1).clamp(min=0)
    return (torch.stack([pair.sum(dim=1) for pair in pairs], dim=1) @ (both - light**2)).float()
