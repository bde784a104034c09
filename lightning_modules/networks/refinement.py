"""Feature refinement over the time points: FR (section 4.3), and the ablation G (one convolution)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightning_modules.networks.layers import ConvBlock, conv


class FeatureRefinement(nn.Module):
    """FR (section 4.3, Fig. 5 c): what deviates from the mean over time is looked at by itself.

    From temporal-pixel features, one time point after another, (B, T features, H, W), to (B, width, H, W).
    """

    def __init__(self, times: int, features: int, width: int) -> None:
        super().__init__()
        self.times = times
        self.base = nn.Sequential(ConvBlock(times * features, width), conv(width, width))
        self.residual = nn.Sequential(ConvBlock(times * features, width), conv(width, width))

    def first(self) -> tuple[Tensor, Tensor]:
        """Weight and bias of the first convolution, that of both branches."""
        base, residual = self.base[0][0], self.residual[0][0]
        # the mean is taken off the weights, which are few, not off the pixels
        weight = residual.weight.unflatten(1, (self.times, -1))
        weight = (weight - weight.mean(dim=1, keepdim=True)).flatten(1, 2)
        return torch.cat([base.weight, weight]), torch.cat([base.bias, residual.bias])

    def finish(self, seen: Tensor) -> Tensor:
        """The layers behind the first convolution."""
        base, residual = self.base[1], self.residual[1]
        weight = torch.cat([base.weight, residual.weight], dim=1)
        return F.conv2d(seen.relu_(), weight, base.bias + residual.bias, padding=1)

    def forward(self, pixels: Tensor) -> Tensor:  # noqa: D102
        return self.finish(F.conv2d(pixels, *self.first(), padding=1))


class TimeFusion(nn.Conv2d):
    """No refinement (ablations F and G): one convolution over the features of all time points."""

    def __init__(self, times: int, features: int, width: int) -> None:
        super().__init__(times * features, width, 3, padding=1)
        self.times = times

    def first(self) -> tuple[Tensor, Tensor]:
        """Its weight and bias."""
        return self.weight, self.bias

    def finish(self, seen: Tensor) -> Tensor:
        """Nothing more."""
        return seen

    @torch.no_grad()
    def start_at_the_mean(self, pixels: int) -> None:
        """Set weights, so that the first channels are the means over time of the first feature.

        A single linear layer with random weights would have to find them behind the noise of every time point: training
        would then stay on a plateau, for a time that depends on the seed. The first feature comes in so many temporal
        ``pixels``, the first channels of every time point.
        """
        weight = self.weight.unflatten(1, (self.times, -1))
        means = min(pixels, len(weight))
        weight[:means] = 0
        for pixel in range(means):
            weight[pixel, :, pixel, 1, 1] = 1 / self.times
