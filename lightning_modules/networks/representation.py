"""Spike representation, features of every time point of one colour: BSSR (section 4.2), and the ablations A and C."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from kornia.core.utils import is_exporting
from torch import Tensor, nn

from lightning_modules.networks.layers import ConvBlock, NoiseLevel, ResBlock, channels_last, conv
from spikekit import tfi, tfi_at

_PIXELS = 1 << 16  # of all time points that a CPU takes at once


class SpikeRepresentation(nn.Module):
    """BSSR of one colour (section 4.2, Fig. 4): features of every time point, from its window and the whole clip.

    Shape:
        - Input: the spikes of one colour, zero elsewhere, :math:`(B, N, H, W)`, and perhaps the level of the noise,
          :math:`(B, 1, 1, 1)`
        - Output: :math:`(B, T, features, H, W)` with :math:`T = (N - window) / stride + 1`
    """

    def __init__(
        self,
        frames: int,
        window: int,
        stride: int,
        width: int,
        features: int,
        global_perception: bool = True,
        noise: bool = False,
    ) -> None:
        super().__init__()
        self.window = window
        self.stride = stride
        self.features = features
        self.local = nn.Sequential(ConvBlock(window, width), ResBlock(width))
        self.whole = nn.Sequential(ConvBlock(frames, width), ResBlock(width)) if global_perception else None
        seen = 2 * width if global_perception else width
        self.fuse = nn.Sequential(ConvBlock(seen, width), ResBlock(width), conv(width, features))
        self.noise = NoiseLevel(width) if noise else None

    @torch.no_grad()
    def start_at_the_mean(self) -> None:
        """Set weights, so that the first feature is the share of the window's frames in which a pixel fired.

        The others are faint: random filters of single spikes are noise to all that follows, and training would first
        have to learn to ignore them.
        """
        local, fuse, last = self.local[0][0], self.fuse[0][0], self.fuse[-1]
        for layer, source, weight in ((local, slice(None), 1 / self.window), (fuse, 0, 1), (last, 0, 1)):
            layer.weight[0] = 0
            layer.weight[0, source, 1, 1] = weight
        for block in (self.local[1], self.fuse[1]):
            block.body[-1].weight[0] = 0
        last.weight[1:] *= 0.1

    def forward(self, spikes: Tensor, noise: Tensor | None = None) -> Tensor:  # noqa: D102
        windows = spikes.unfold(1, self.window, self.stride).movedim(-1, 2)
        everywhere = None
        if self.whole is not None:
            # what is seen of the whole clip is the same at all times: it is convolved once, apart
            _, weight = self.fuse[0][0].weight.chunk(2, dim=1)
            everywhere = F.conv2d(self.whole(channels_last(spikes)), weight, padding=1).unsqueeze(1)
        few = windows.shape[1]
        if spikes.device.type == "cpu" and not (torch.is_grad_enabled() or torch.jit.is_tracing()):
            few = max(1, _PIXELS // spikes[:, 0].numel())  # time points at once, so that they stay in the cache
        parts = [self._features(part, everywhere, noise) for part in windows.split(few, dim=1)]
        return torch.cat(parts, dim=1)

    def _features(self, windows: Tensor, everywhere: Tensor | None, noise: Tensor | None) -> Tensor:
        """Features (B, T, features, H, W) of some time points, given their windows (B, T, window, H, W)."""
        batch, times = windows.shape[:2]
        (fuse, relu), block, last = self.fuse
        local = self.local(channels_last(windows.flatten(0, 1)))
        seen = F.conv2d(local, fuse.weight[:, : local.shape[1]], fuse.bias, padding=1)
        if everywhere is not None:
            seen.unflatten(0, (batch, times)).add_(everywhere)
        if noise is not None:
            seen = self.noise(seen, noise.repeat_interleave(times, dim=0))
        return last(block(relu(seen))).unflatten(0, (batch, times))


class WindowMeans(nn.Module):
    """The spikes as they are, without weights (ablation A): the share of a window's frames in which a pixel fired.

    Example:
        >>> spikes = torch.tensor([1.0, 0, 1, 1, 1]).reshape(1, 5, 1, 1)
        >>> WindowMeans(window=3, stride=2)(spikes).flatten().tolist()
        [0.666..., 1.0]
    """

    features = 1

    def __init__(self, window: int, stride: int) -> None:
        super().__init__()
        self.window = window
        self.stride = stride

    def forward(self, spikes: Tensor) -> Tensor:  # noqa: D102
        return spikes.unfold(1, self.window, self.stride).mean(dim=-1).unsqueeze(2)


class IntervalRepresentation(nn.Module):
    r"""Light from spike intervals, without weights (ablation C): :math:`1 / \Psi` of eq. (5) at every time point.

    A pixel that never fires gives 0, those of the other colours among them.

    Example:
        >>> spikes = torch.tensor([[0.0, 0], [1, 0], [0, 0], [0, 0], [1, 0]]).reshape(1, 5, 1, 2)
        >>> IntervalRepresentation([2, 3])(spikes)[0, :, 0, 0].tolist()
        [[0.333..., 0.0], [0.333..., 0.0]]
    """

    features = 1

    def __init__(self, times: Sequence[int]) -> None:
        super().__init__()
        self.times = list(times)

    def forward(self, spikes: Tensor) -> Tensor:  # noqa: D102
        fired = spikes.any(dim=1, keepdim=True)
        if is_exporting():  # of the operators of TFI, that of single frames has a path which other programs know
            light = torch.stack([tfi_at(spikes, n) for n in self.times], dim=1)
        else:
            light = tfi(spikes)[:, self.times]
        return (light * fired).unsqueeze(2)
