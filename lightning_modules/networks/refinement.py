"""Feature refinement over the time points: FR (section 4.3), and ablation G (one convolution)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightning_modules.networks.layers import ConvBlock, conv, fused_conv


class FeatureRefinement(nn.Module):
    """FR (section 4.3, Fig. 5 c): separate branches for the features and for their deviation from the temporal mean.

    Maps the features of all time points, (B, T features, H, W), to (B, width, H, W).
    """

    def __init__(self, times: int, features: int, width: int) -> None:
        super().__init__()
        self.times = times
        self.base = nn.Sequential(ConvBlock(times * features, width), conv(width, width))
        self.residual = nn.Sequential(ConvBlock(times * features, width), conv(width, width))

    def forward(self, pixels: Tensor) -> Tensor:  # noqa: D102
        (base, base_end), (residual, residual_end) = ((part[0][0], part[1]) for part in (self.base, self.residual))
        # subtracting the mean from the few weights is cheaper than from the pixels
        weight = residual.weight.unflatten(1, (self.times, -1))
        weight = torch.cat([base.weight, (weight - weight.mean(dim=1, keepdim=True)).flatten(1, 2)])
        seen = fused_conv(pixels, weight, torch.cat([base.bias, residual.bias]))
        weight = torch.cat([base_end.weight, residual_end.weight], dim=1)
        return F.conv2d(seen, weight, base_end.bias + residual_end.bias, padding=1)


class TimeFusion(nn.Conv2d):
    """One convolution over the features of all time points, without refinement (ablations F and G)."""

    def __init__(self, times: int, features: int, width: int) -> None:
        super().__init__(times * features, width, 3, padding=1)
        self.times = times

    @torch.no_grad()
    def start_at_the_mean(self, pixels: int) -> None:
        """Initialise the first channels as temporal means of the first feature.

        With random weights, training of this single linear layer stays on a plateau, for a time that depends on the
        seed. The first feature of each time point has ``pixels`` channels, one per temporal pixel.
        """
        weight = self.weight.unflatten(1, (self.times, -1))
        means = min(pixels, len(weight))
        weight[:means] = 0
        for pixel in range(means):
            weight[pixel, :, pixel, 1, 1] = 1 / self.times
