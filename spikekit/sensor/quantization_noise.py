"""Quantisation noise: the variance of weighted sums of spikes under constant light."""

from __future__ import annotations

import torch
from torch import Tensor


def flicker(weights: Tensor, light: Tensor) -> Tensor:
    r"""Return the variance of weighted sums of a pixel's spikes in constant light, over all initial charges.

    In light r, an ideal pixel fires for a share r of all initial phases: an arc of the circle. The arc of the phases
    that fire d frames later is rotated by d r. The overlap of both arcs minus :math:`r^2` is the covariance of two
    spikes d frames apart.

    Args:
        weights: weights of K sums over N frames, (K, N).
        light: light in thresholds per frame, 0 to 1, (L).

    Returns:
        Variances (K, L), float32.

    Example:
        >>> flicker(torch.ones(1, 1), torch.tensor([0.0, 0.25, 0.5]))  # one spike with this probability
        tensor([[0.0000, 0.1875, 0.2500]])
    """
    weights, light = weights.double(), light.double()
    frames = weights.shape[-1]
    pairs = [(2 if apart else 1) * weights[:, : frames - apart] * weights[:, apart:] for apart in range(frames)]
    moved = torch.arange(frames, dtype=torch.float64).unsqueeze(1) * light % 1
    both = (light - moved).clamp(min=0) + (moved + light - 1).clamp(min=0)
    return (torch.stack([pair.sum(dim=1) for pair in pairs], dim=1) @ (both - light**2)).float()
