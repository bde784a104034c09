"""SwinIR on the demosaiced picture of the middle frame, the paper's "3DRI + SwinIR"."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightning_modules.networks.baselines.parts import (
    Baseline,
    along_motion,
    begin_at_zero,
    cut_to,
    enlarge_picture,
    mirror_to_multiple,
    whole_sizes,
)
from lightning_modules.networks.layers import conv
from lightning_modules.signatures import inherit_signature

_MEAN = 0.4488, 0.4371, 0.4040  # mean colour of DIV2K, SwinIR's training data
_SIDE = 8  # side of an attention window, in pixels
_SHIFT = _SIDE // 2
_DROP = 0.1  # probability of skipping the last layer in training (stochastic depth); 0 for the first, linear between


class SwinIR(Baseline):
    r"""SwinIR, residual groups of window attention, on the 3DRI-like picture of the middle frame.

    As published: all layers, their widths and their order; parameters and initialisation are those of the light SwinIR
    for RGB. Differences: the picture is :func:`spikekit.demosaic_along_motion` of five TFI mosaics, without
    gradient; padding reflects without repeating the edge pixel; ``skip`` is optional; the training is that of all
    networks here. The original uses the l1 loss and Adam at 2e-4 with betas of 0.9 and 0.99, for 500,000 steps, halved
    at 250, 400, 450 and 475 thousand.

    Args:
        scale, frames, pattern, alpha, motion: see :class:`Baseline`.
        width: channels.
        groups: residual groups.
        layers: attention layers per group; every other one shifts its windows by half their side.
        heads: attention heads, a divisor of ``width``.
        skip: predict a residual, which is added to the bicubically enlarged picture, so that training starts from the
            result of demosaicing. The publication has no such skip.

    Shape:
        - Input: spikes :math:`(B, N, H, W)` of any real dtype, with H and W of at least 3; optionally flow
          :math:`(B, 2, 2, H, W)`, from the middle to frames 5 and 35 of 41, in sensor pixels
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Raises:
        ValueError: a size is below 1, or heads do not divide the width.

    Example:
        >>> network = SwinIR(scale=2, width=12, groups=1, layers=2, heads=2)
        >>> network(torch.zeros(1, 41, 12, 10), static=True).shape
        torch.Size([1, 3, 24, 20])

    Reference:
        Liang et al., SwinIR: Image Restoration Using Swin Transformer, ICCV Workshops 2021.
    """

    halo = None  # shifted windows widen the receptive field: 24 layers see about a hundred pixels

    @inherit_signature(Baseline, "more")
    def __init__(
        self,
        *args: Any,
        width: int = 60,
        groups: int = 4,
        layers: int = 6,
        heads: int = 6,
        skip: bool = False,
        **common: Any,
    ) -> None:
        sizes = whole_sizes(width=width, groups=groups, layers=layers, heads=heads)
        if width % heads:
            raise ValueError(f"heads: expected a divisor of width = {width}, got {heads}")
        super().__init__(*args, **common, more={**sizes, "skip": skip})
        self.skip = skip
        count = groups * layers
        drops = [_DROP * n / max(count - 1, 1) for n in range(count)]
        self.first = conv(3, width)
        self.embed = nn.LayerNorm(width)
        self.groups = nn.ModuleList(ResidualGroup(width, heads, drops[n : n + layers]) for n in range(0, count, layers))
        self.norm = nn.LayerNorm(width)
        self.after = conv(width, width)
        self.upsample = nn.Sequential(conv(width, 3 * self.scale**2), nn.PixelShuffle(self.scale))
        self.register_buffer("mean", torch.tensor(_MEAN).reshape(3, 1, 1), persistent=False)
        for module in self.groups.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                nn.init.zeros_(module.bias)
        if skip:
            begin_at_zero(self.upsample[0])

    def forward(self, spikes: Tensor, flow: Tensor | None = None, static: bool = False) -> Tensor:  # noqa: D102
        self.check_spikes(spikes)
        picture = along_motion(self, spikes, self.flow_or_estimate(spikes, flow, static)).to(self.first.weight.dtype)
        height, width = picture.shape[-2:]
        shallow = self.first(mirror_to_multiple(picture - self.mean, _SIDE))
        tokens, hidden = self.embed(shallow.movedim(1, -1)), _hidden(*shallow.shape[-2:], shallow.device)
        for group in self.groups:
            tokens = group(tokens, hidden)
        deep = self.after(self.norm(tokens).movedim(-1, 1))
        rgb = cut_to(self.upsample(shallow + deep), self.scale * height, self.scale * width).to(picture)
        return rgb + enlarge_picture(picture, self.scale) if self.skip else rgb + self.mean


class ResidualGroup(nn.Module):
    """Residual group (RSTB): attention layers and a convolution, plus the input, (B, H, W, C) to (B, H, W, C)."""

    def __init__(self, width: int, heads: int, drops: list[float]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            AttentionLayer(width, heads, _SHIFT if n % 2 else 0, drop) for n, drop in enumerate(drops)
        )
        self.conv = conv(width, width)

    def forward(self, tokens: Tensor, hidden: Tensor) -> Tensor:  # noqa: D102
        deep = tokens
        for layer in self.layers:
            deep = layer(deep, hidden)
        return tokens + self.conv(deep.movedim(-1, 1)).movedim(1, -1)


class AttentionLayer(nn.Module):
    """Attention layer (STL): window attention and a two-layer perceptron, each with layer norm and a skip."""

    def __init__(self, width: int, heads: int, shift: int, drop: float) -> None:
        super().__init__()
        self.heads, self.shift, self.drop = heads, shift, drop
        self.norms = nn.ModuleList([nn.LayerNorm(width), nn.LayerNorm(width)])
        self.qkv = nn.Linear(width, 3 * width)
        self.project = nn.Linear(width, width)
        self.bias = nn.Parameter(torch.empty((2 * _SIDE - 1) ** 2, heads))
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        self.register_buffer("offset", _offsets(), persistent=False)
        nn.init.trunc_normal_(self.bias, std=0.02)

    def forward(self, tokens: Tensor, hidden: Tensor) -> Tensor:  # noqa: D102
        tokens = tokens + self._drop(self._attend(self.norms[0](tokens), hidden))
        return tokens + self._drop(self.mlp(self.norms[1](tokens)))

    def _attend(self, tokens: Tensor, hidden: Tensor) -> Tensor:
        batch, height, width, channels = tokens.shape
        grid = height // _SIDE, width // _SIDE
        tokens = tokens.roll((-self.shift, -self.shift), (1, 2))
        # (3, B, windows, heads, pixels of a window, channels of a head)
        parts = self.qkv(_windows(tokens)).unflatten(-1, (3, self.heads, -1)).movedim(3, 0).transpose(-2, -3)
        query, key, value = parts.unbind(0)
        bias = self.bias[self.offset].movedim(-1, 0)
        bias = (bias + hidden if self.shift else bias[None]).to(query.dtype)
        seen = F.scaled_dot_product_attention(query, key, value, bias).transpose(-2, -3).flatten(-2)
        seen = self.project(seen).unflatten(1, grid).unflatten(3, (_SIDE, _SIDE))
        seen = seen.transpose(2, 3).reshape(batch, height, width, channels)
        return seen.roll((self.shift, self.shift), (1, 2))

    def _drop(self, change: Tensor) -> Tensor:
        """Apply stochastic depth: skip the layer for random clips, and scale it up for the others."""
        return change * F.dropout(change.new_ones(len(change), 1, 1, 1), self.drop, self.training)


def _windows(planes: Tensor) -> Tensor:
    """Partition (B, H, W, C) into windows, (B, windows, pixels of a window, C)."""
    batch, height, width, channels = planes.shape
    parts = planes.reshape(batch, height // _SIDE, _SIDE, width // _SIDE, _SIDE, channels)
    return parts.transpose(2, 3).reshape(batch, -1, _SIDE**2, channels)


def _offsets() -> Tensor:
    """Return the index of the relative position bias of each pair of pixels of a window."""
    at = torch.stack(torch.meshgrid(torch.arange(_SIDE), torch.arange(_SIDE), indexing="ij")).flatten(1)
    rows, columns = at[:, :, None] - at[:, None, :] + _SIDE - 1
    return rows * (2 * _SIDE - 1) + columns


def _hidden(height: int, width: int, device: torch.device) -> Tensor:
    """Return the mask of shifted windows, (windows, 1, pixels, pixels), -100 between pixels of different regions."""
    parts = []
    for length in (height, width):
        at = torch.arange(length, device=device)
        parts.append((at >= length - _SIDE).long() + (at >= length - _SHIFT))
    part = _windows((3 * parts[0][:, None] + parts[1])[None, :, :, None])[0, :, :, 0]
    return torch.where(part[:, :, None] == part[:, None, :], 0.0, -100.0)[:, None]
