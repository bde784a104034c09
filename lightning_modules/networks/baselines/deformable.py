"""Modulated deformable convolution, 3 x 3."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightning_modules.networks.layers import conv


class DeformableConv2d(nn.Module):
    r"""Modulated deformable 3 x 3 convolution; a convolution predicts its offsets and masks from guide features.

    The predictor is initialised with zeros: no offset, and all masks 0.5. Positions are computed in the precision of
    the weights, also under autocast. Each of the ``groups`` of channels has its own offsets.

    Shape:
        - Input: features and guide, each :math:`(B, C, H, W)`
        - Output: :math:`(B, C, H, W)`

    Example:
        >>> DeformableConv2d(8, groups=2)(torch.rand(1, 8, 5, 6), torch.rand(1, 8, 5, 6)).shape
        torch.Size([1, 8, 5, 6])

    Reference:
        Zhu et al., Deformable ConvNets v2, CVPR 2019.
    """

    def __init__(self, width: int, groups: int = 8) -> None:
        super().__init__()
        if width % groups:
            raise ValueError(f"width: expected a multiple of {groups}, the groups of offsets, got {width}")
        self.where = conv(width, 27 * groups)
        nn.init.zeros_(self.where.weight)
        nn.init.zeros_(self.where.bias)
        taps = conv(width, width)
        self.weight, self.bias = taps.weight, taps.bias

    def forward(self, features: Tensor, guide: Tensor) -> Tensor:  # noqa: D102
        from kornia.feature.aliked.deform_conv2d import deform_conv2d

        where = self.where(guide).to(self.weight.dtype)
        offsets, masks = where.split([where.shape[1] * 2 // 3, where.shape[1] // 3], dim=1)
        with torch.autocast(features.device.type, enabled=False):
            features = features.to(self.weight.dtype)
            return deform_conv2d(features, offsets, self.weight, self.bias, padding=1, mask=masks.sigmoid())
