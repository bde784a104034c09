"""Spike representation, the features of one colour at each time point: BSSR (section 4.2), and ablations A and C."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.compiler import is_exporting

from lightning_modules.networks.layers import ConvBlock, NoiseLevel, ResBlock, channels_last, conv
from spikekit import tfi, tfi_at

_PIXELS = 1 << 16  # pixels of all time points per step on a CPU


class SpikeRepresentation(nn.Module):
    """BSSR of one colour (section 4.2, Fig. 4): features of each time point, from its window and the whole clip.

    Shape:
        - Input: spikes :math:`(B, N, H, W)` of one colour, zero at other pixels; optionally the noise level,
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
        """Initialise the first feature as the firing rate in the window, and scale down the others.

        Random filters of single spikes are noise that training would first have to suppress.
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
            # features of the whole clip are the same for all time points, so they are convolved once
            seen = self.whole(spikes)
            everywhere = F.conv2d(seen, self.fuse[0][0].weight[:, -seen.shape[1] :], padding=1).unsqueeze(1)
        if spikes.device.type != "cpu" or torch.is_grad_enabled() or torch.jit.is_tracing() or is_exporting():
            return self._features(windows, everywhere, noise)
        few = max(1, _PIXELS // spikes[:, 0].numel())  # time points per step, to fit in the cache
        parts = [self._features(part, everywhere, noise) for part in windows.split(few, dim=1)]
        return torch.cat(parts, dim=1)

    def _features(self, windows: Tensor, everywhere: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return the features (B, T, features, H, W) of windows (B, T, window, H, W)."""
        batch, times = windows.shape[:2]
        (fuse, relu), block, last = self.fuse
        local = self.local(channels_last(windows.flatten(0, 1)))
        seen = F.conv2d(local, fuse.weight[:, : local.shape[1]], fuse.bias, padding=1)
        if everywhere is not None:
            seen.unflatten(0, (batch, times)).add_(everywhere)
        if noise is not None and self.noise is not None:
            seen = self.noise(seen, noise.repeat_interleave(times, dim=0))
        return last(block(relu(seen))).unflatten(0, (batch, times))


class WindowMeans(nn.Module):
    """Mean of the spikes in each window, without weights (ablation A).

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
    r"""Light from spike intervals, without weights (ablation C): :math:`1 / \Psi` of eq. (5) at each time point.

    Pixels that never fire are 0, and so are the pixels of other colours.

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
        if is_exporting():  # only tfi_at has an exportable implementation
            light = torch.stack([tfi_at(spikes, n) for n in self.times], dim=1)
        else:
            light = tfi(spikes)[:, self.times]
        return (light * fired).unsqueeze(2)
