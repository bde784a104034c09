"""Network of Spike2Flow: features, correlations, and iterative refinement of three flows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

_ALL_PAIRS = 1600  # maximum number of pixels for all-pairs correlation; above, lookup is faster and saves memory


def _convolved(inputs: int, outputs: int, size: int, stride: int = 1, *, norm: bool = False) -> list[nn.Module]:
    """Return a padded convolution, optional instance normalisation, and ReLU."""
    convolution = nn.Conv2d(inputs, outputs, size, stride, padding=size // 2)
    return [convolution, *([nn.InstanceNorm2d(outputs)] if norm else []), nn.ReLU(inplace=True)]


class ResidualBlock(nn.Module):
    """Residual block: two 3 x 3 convolutions with instance normalisation, and a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        first, second = _convolved(inputs, outputs, 3, stride, norm=True), _convolved(outputs, outputs, 3, norm=True)
        self.body = nn.Sequential(*first, *second)
        self.shortcut = nn.Identity()
        if stride > 1:
            self.shortcut = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride), nn.InstanceNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        return F.relu(self.shortcut(x) + self.body(x))


class GlobalAttention(nn.Module):
    """Self-attention over all positions, with a learned gain that starts at 0."""

    def __init__(self, width: int, values: int) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm2d(width)
        self.query_key = nn.Conv2d(width, 2 * 4 * values, 1, bias=False)
        self.value = nn.Conv2d(width, values, 1, bias=False)
        self.project = nn.Conv2d(values, width, 1, bias=False)
        self.gain = nn.Parameter(torch.zeros(1))
        self.temperature = values**-0.5

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        normed = self.norm(x)
        query, key, value = (
            part.flatten(2).transpose(1, 2) for part in (*self.query_key(normed).chunk(2, dim=1), self.value(normed))
        )
        found = F.scaled_dot_product_attention(query, key, value, scale=self.temperature)
        return x + self.gain * self.project(found.transpose(1, 2).unflatten(2, x.shape[-2:]))


class Encoder(nn.Sequential):
    """Encoder of a window of frames; each stage halves the resolution."""

    def __init__(self, window: int, widths: Sequence[int], blocks: int, outputs: int, attention: int) -> None:
        layers = _convolved(window, widths[0], 7, 2, norm=True)
        for stage, (before, width) in enumerate(zip([widths[0], *widths], widths, strict=False)):
            layers.append(ResidualBlock(before, width, 1 if stage == 0 else 2))
            layers += [ResidualBlock(width, width) for _ in range(blocks - 1)]
        layers.append(nn.Conv2d(widths[-1], outputs, 1))
        if attention:
            layers.append(GlobalAttention(outputs, attention))
        super().__init__(*layers)


class Correlation:
    """Correlation of each pixel's features with those around the end of its flow, on several scales.

    Small pictures store the correlations of all pairs of pixels; large ones compute only those that are looked up. Both
    give the same result, because pooling and interpolation are linear. Flows lead from ``features``, (B, C, h, w), to
    ``others``, (B, K, C, h, w).
    """

    def __init__(self, features: Tensor, others: Tensor, levels: int, radius: int) -> None:
        self.height, self.width = features.shape[-2:]
        self.all_pairs = self.height * self.width <= _ALL_PAIRS
        features = features.flatten(2) / math.sqrt(features.shape[1])
        wide = torch.promote_types(features.dtype, torch.float32)  # half precision is too coarse for pixel positions
        if self.all_pairs:
            level = torch.einsum("bcp,bkcq->bkpq", features, others.flatten(3)).reshape(-1, 1, self.height, self.width)
        else:
            level = others.flatten(0, 1)
            self.features = features.repeat_interleave(others.shape[1], dim=0).unsqueeze(-1)  # (B K, C, h w, 1)
        level = level.to(wide)
        self.pyramid = [level]
        for _ in range(levels - 1):
            # ceil_mode keeps the last odd row and column, and at least one pixel
            level = F.avg_pool2d(level, 2, ceil_mode=True)
            self.pyramid.append(level)
        self.around = _positions(range(-radius, radius + 1), range(-radius, radius + 1), level)  # (k k, 2)
        self.here = _positions(range(self.height), range(self.width), level)  # (h w, 2)

    def __call__(self, flow: Tensor) -> Tensor:
        """Look up the correlations of a flow, (B K, 2, h, w) to (B K, levels k k, h, w)."""
        there = (self.here + flow.flatten(2).transpose(1, 2)).unsqueeze(2) + 0.5  # (B K, h w, 1, 2)
        found = []
        for number, level in enumerate(self.pyramid):
            # align_corners=False divides by the width, not by width - 1, so a width of one pixel is valid
            size = there.new_tensor([level.shape[-1], level.shape[-2]])
            grid = (there / 2**number + self.around) * (2 / size) - 1
            if self.all_pairs:
                picked = F.grid_sample(level, grid.flatten(0, 1).unsqueeze(1), align_corners=False)
                found.append(picked.reshape(grid.shape[:-1]))
            else:
                found.append((self.features * F.grid_sample(level, grid, align_corners=False)).sum(dim=1))
        return torch.cat(found, dim=-1).transpose(1, 2).unflatten(2, (self.height, self.width)).to(flow.dtype)


def _positions(rows: range, columns: range, like: Tensor) -> Tensor:
    """Return all positions (x, y) in row-major order, (rows columns, 2)."""
    y, x = (torch.tensor(axis, dtype=like.dtype, device=like.device) for axis in (rows, columns))
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).flatten(0, 1)


class MotionEncoder(nn.Module):
    """Encoder of a flow and its correlations."""

    def __init__(self, looked_up: int, correlation: tuple[int, int], motion: int) -> None:
        super().__init__()
        self.correlation = nn.Sequential(*_convolved(looked_up, correlation[0], 1), *_convolved(*correlation, 3))
        self.flow = nn.Sequential(*_convolved(2, motion, 7), *_convolved(motion, motion // 2, 3))
        self.both = nn.Sequential(*_convolved(correlation[1] + motion // 2, motion - 2, 3))

    def forward(self, correlation: Tensor, flow: Tensor) -> Tensor:  # noqa: D102
        both = self.both(torch.cat([self.correlation(correlation), self.flow(flow)], dim=1))
        return torch.cat([both, flow], dim=1)


class SeparableGRU(nn.Module):
    """Convolutional gated recurrent unit, once along the rows and once along the columns."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.gates = nn.ModuleList()
        self.candidates = nn.ModuleList()
        for size, padding in (((1, 5), (0, 2)), ((5, 1), (2, 0))):
            self.gates.append(nn.Conv2d(hidden + inputs, 2 * hidden, size, padding=padding))
            self.candidates.append(nn.Conv2d(hidden + inputs, hidden, size, padding=padding))

    def forward(self, hidden: Tensor, inputs: Tensor) -> Tensor:  # noqa: D102
        for gates, candidate in zip(self.gates, self.candidates, strict=True):
            update, reset = gates(torch.cat([hidden, inputs], dim=1)).sigmoid().chunk(2, dim=1)
            new = candidate(torch.cat([reset * hidden, inputs], dim=1)).tanh()
            hidden = torch.lerp(hidden, new, update)
        return hidden


class RecurrentFlow(nn.Module):
    r"""Joint refinement of the flows from one window of frames to three later, equidistant windows.

    For the arguments see :class:`lightning_modules.motion.Spike2Flow`.

    Shape:
        - Input: windows :math:`(B, 4, window, h, w)`, any h and w
        - Output: flows :math:`(B, 3, 2, h, w)` in pixels, from the first window to the others, for each iteration

    Reference:
        Zhao et al., Learning Optical Flow from Continuous Spike Streams, NeurIPS 2022; Teed and Deng, RAFT, ECCV 2020.
    """

    def __init__(
        self,
        window: int,
        widths: Sequence[int],
        blocks: int,
        features: int,
        attention: int,
        hidden: int,
        correlation: tuple[int, int],
        motion: int,
        head: int,
        levels: int,
        radius: int,
    ) -> None:
        super().__init__()
        self.stride = 2 ** len(widths)
        self.hidden, self.levels, self.radius = hidden, levels, radius
        self.features = Encoder(window, widths, blocks, features, attention)
        self.context = Encoder(window, widths, blocks, 2 * hidden, attention)
        self.motion = MotionEncoder(levels * (2 * radius + 1) ** 2, correlation, motion)
        self.update = SeparableGRU(hidden, hidden + 3 * motion)
        self.heads = nn.ModuleList(_head(hidden, head, 2, 3) for _ in range(3))
        self.mask = _head(hidden, head, 9 * self.stride**2, 1)

    def forward(self, windows: Tensor, iterations: int) -> list[Tensor]:  # noqa: D102
        batch, _, _, height, width = windows.shape
        # at least two pixels of features, as instance normalisation needs a variance
        bottom, right = (max(-side % self.stride, 2 * self.stride - side) for side in (height, width))
        windows = F.pad(windows.flatten(0, 1), (0, right, 0, bottom), "replicate").unflatten(0, (batch, 4))
        features = self.features(windows.flatten(0, 1)).unflatten(0, (batch, 4))
        hidden, context = self.context(windows[:, 0]).split(self.hidden, dim=1)
        hidden, context = hidden.tanh(), context.relu()

        correlation = Correlation(features[:, 0], features[:, 1:], self.levels, self.radius)
        flow = windows.new_zeros(3 * batch, 2, *hidden.shape[-2:])
        flows = []
        for _ in range(iterations):
            flow = flow.detach()
            motion = self.motion(correlation(flow), flow).unflatten(0, (batch, 3))
            hidden = self.update(hidden, torch.cat([context, motion.flatten(1, 2)], dim=1))
            # motion is nearly steady, so its error grows with time
            step = torch.stack([(k + 1) * head(hidden) for k, head in enumerate(self.heads)], dim=1)
            flow = flow + step.flatten(0, 1)
            fine = upsample_convex(flow.unflatten(0, (batch, 3)), 0.25 * self.mask(hidden), self.stride)
            flows.append(fine[..., :height, :width])
        return flows


def _head(inputs: int, width: int, outputs: int, size: int) -> nn.Sequential:
    last = nn.Conv2d(width, outputs, size, padding=size // 2)
    return nn.Sequential(*_convolved(inputs, width, 3), last)


def upsample_convex(flow: Tensor, weights: Tensor, scale: int) -> Tensor:
    """Upsample flow (B, K, 2, h, w); each fine pixel is a convex combination of the nine coarse pixels around it.

    The weights are (B, 9 scale scale, h, w), before the softmax over the nine pixels.
    """
    batch, count, _, height, width = flow.shape
    around = F.unfold(F.pad(flow.flatten(1, 2), (1, 1, 1, 1), "replicate"), 3)
    around = around.reshape(batch, count * 2, 9, 1, height, width)
    weights = weights.reshape(batch, 1, 9, scale**2, height, width).softmax(dim=2)
    fine = scale * (around * weights).sum(dim=2)
    return F.pixel_shuffle(fine.flatten(1, 2), scale).unflatten(1, (count, 2))
