"""Spike2Flow, learned motion estimation on the spike intervals of the four sub-streams."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lightning_modules.motion.estimator import MotionEstimator, split_any_size
from lightning_modules.motion.recurrent import RecurrentFlow
from lightning_modules.storage.pretrained import check_weights, load_weights, read_weights
from spikekit import spike_interval
from spikekit.check import check_planes

_PIXELS = 1 << 17  # pixels of sub-streams per batch


class Spike2Flow(MotionEstimator):
    r"""Recurrent optical flow from the spike intervals of the four sub-streams.

    Four equidistant windows of spike intervals, from the middle of the clip to its last time point, give three flows
    that are refined together; the third is the result. The flow to the first time point is that of the time-reversed
    stream. The outermost intervals are repeated beyond the ends of the clip. One network processes all sub-streams and
    both directions as one batch.

    The default size is small, because the network runs eight times per clip. The paper's size is::

        Spike2Flow(window=21, widths=(64, 96, 128), blocks=2, features=216, attention=128, hidden=128,
                   correlation=(196, 160), motion=96, head=196, levels=3, radius=3, iterations=8)

    with 6,501,830 parameters. The authors count 101,888 more, which do not affect the result.

    Args:
        window: number of spike frames per window, odd.
        widths: channels of the encoders' stages; each stage halves the resolution at which motion is estimated.
        blocks: residual blocks per stage.
        features: channels of the correlated features.
        attention: channels of the encoders' global attention, 0 for none.
        hidden: channels of the recurrent state, and of the context.
        correlation: channels of the two layers that encode the correlations.
        motion: channels of the motion features per flow, even.
        head: hidden channels of the flow heads and of the upsampling weights.
        levels: scales of the correlations.
        radius: lookup radius of the correlations, in pixels of each scale.
        iterations: number of refinements; it may differ from that of training.
        weights: ``"spike2flow"``, in the package, of the default size; path of a safetensors file; or checkpoint of
            ``lightning fit -c configs/flow.yaml``. Default: random weights.
        frozen: estimate without gradient, and do not train the weights.

    Shape:
        As :class:`MotionEstimator`; spikes of at least 2 x 2 pixels.

    Raises:
        FileNotFoundError: ``weights`` is neither a file nor a known name.
        ValueError: an argument is out of range, or the file is damaged or holds another network.

    Example:
        >>> to_first, to_last = Spike2Flow()(torch.zeros(1, 41, 24, 20), (5, 20, 35), "RGGB")
        >>> to_last.shape
        torch.Size([1, 2, 24, 20])

    Reference:
        Zhao et al., Learning Optical Flow from Continuous Spike Streams, NeurIPS 2022; Dong et al., CVPR 2024,
        section 4.3 and eq. (7).
    """

    def __init__(
        self,
        window: int = 11,
        widths: Sequence[int] = (24,),
        blocks: int = 1,
        features: int = 32,
        attention: int = 0,
        hidden: int = 24,
        correlation: tuple[int, int] = (32, 24),
        motion: int = 16,
        head: int = 24,
        levels: int = 2,
        radius: int = 2,
        iterations: int = 3,
        weights: str | Path | None = None,
        frozen: bool = False,
    ) -> None:
        super().__init__()
        one_each = {"blocks": blocks, "features": features, "hidden": hidden, "head": head}
        one_each |= {"levels": levels, "radius": radius}
        several = {"widths": list(widths), "correlation": list(correlation)}
        for name, sizes in [*several.items(), *((name, [size]) for name, size in one_each.items())]:
            if not sizes or min(sizes) < 1:
                raise ValueError(f"{name}: expected 1 or more, got {sizes}")
        if iterations < 1 or attention < 0:
            raise ValueError(f"iterations, attention: expected 1 or more and 0 or more, got {iterations}, {attention}")
        if window < 1 or window % 2 == 0:
            raise ValueError(f"window: expected a positive odd number, got {window}")
        if motion < 4 or motion % 2:
            raise ValueError(f"motion: expected an even number of at least 4, got {motion}")
        self.settings: dict[str, Any] = {
            **{"window": window, "attention": attention, "motion": motion},
            **one_each,
            **several,
        }
        self.window, self.iterations, self.frozen = window, iterations, frozen
        self.network = RecurrentFlow(**self.settings)
        if weights is not None:
            found = read_weights(weights)
            check_weights(found, {type(self).__name__: type(self)})
            load_weights(self, found)
        if frozen:
            self.requires_grad_(False)

    def channel_flows(  # noqa: D102
        self, spikes: Tensor, times: tuple[int, int, int], pattern: str
    ) -> tuple[Tensor, Tensor]:
        return self.refinements(spikes, times, pattern)[-1][:, :, :, 2].unbind(2)

    def refinements(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> list[Tensor]:
        """Return all flows of each iteration, for training.

        Args:
            spikes: (B, N, H, W), any real dtype.
            times: first, middle and last time points, in spike frames.
            pattern: Bayer phase.

        Returns:
            For each iteration, flows :math:`(4, B, 2, 3, 2, h, w)` in Bayer cells. The axes are: sub-streams, clips,
            to the first and last time points, a third, two thirds and all of the way, (x, y), height and width.
        """
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        first, middle, last = times
        end = spikes.shape[1] - 1
        backwards = self._windows(spikes.flip(1), end - middle, end - first, pattern)
        windows = torch.stack([backwards, self._windows(spikes, middle, last, pattern)], dim=2)
        # large clips are split into sub-streams, as each position needs memory for its correlations
        few = max(1, _PIXELS // (windows.shape[-2] * windows.shape[-1]))
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            parts = [self.network(part, self.iterations) for part in windows.flatten(0, 2).split(few)]
        return [torch.cat(flows).unflatten(0, windows.shape[:3]) for flows in zip(*parts, strict=True)]

    def _windows(self, spikes: Tensor, middle: int, last: int, pattern: str) -> Tensor:
        """Return four windows of intervals, from the middle to the last time point, (4, B, 4, window, h, w)."""
        intervals = split_any_size(spike_interval(spikes).to(next(self.parameters()).dtype), pattern)
        centers = torch.tensor([round(middle + (last - middle) * k / 3) for k in range(4)])
        frames = centers[:, None] + torch.arange(self.window) - self.window // 2
        return intervals[:, :, frames.clamp(0, spikes.shape[1] - 1).to(spikes.device)]
