"""Learned motion estimation: Spike2Flow on the spike intervals of the four sub-streams."""

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

_PIXELS = 1 << 17  # of streams that are worked on in one go


class Spike2Flow(MotionEstimator):
    r"""Recurrent flow from the spike intervals of the four sub-streams, to both ends of the clip.

    Of every sub-stream, windows of intervals around four times at equal distances, the middle one first and the last
    time point last, give three flows that are refined together; the third is the result. The flow to the first time
    point is that of the stream reversed in time. Where a window reaches beyond the clip, the outermost intervals are
    repeated. Sub-streams and directions are one batch, and one network for all.

    The defaults are a small size of this project, because the network runs eight times a clip. The paper's is::

        Spike2Flow(window=21, widths=(64, 96, 128), blocks=2, features=216, attention=128, hidden=128,
                   correlation=(196, 160), motion=96, head=196, levels=3, radius=3, iterations=8)

    with 6,501,830 parameters, those that the authors count less the 101,888 that nothing depends on.

    Args:
        window: frames of a window, odd.
        widths: channels of the encoders' stages; motion is estimated at a size that is halved once for each.
        blocks: residual blocks of each stage.
        features: channels that are correlated.
        attention: channels of the encoders' global attention, 0 for none.
        hidden: channels of the recurrent state, and as many of context.
        correlation: channels that the correlations are encoded with.
        motion: channels of the motion features of a flow, even.
        head: channels in front of the flow increments and of the upsampling weights.
        levels: scales of the correlations.
        radius: how far the correlations are looked up, in pixels of each scale.
        iterations: how often the flows are refined; any number serves, whatever was trained with.
        weights: ``"spike2flow"``, which comes with the package and is of the default size; a file of safetensors, or a
            checkpoint of ``lightning fit -c configs/flow.yaml``. Random weights when not given.
        frozen: estimate without gradient, and never learn.

    Shape:
        As :class:`MotionEstimator`; spikes of at least 2 x 2 pixels.

    Raises:
        FileNotFoundError: there are no such weights.
        ValueError: an argument that makes no sense, a file that is damaged or of another network; the message names it.

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
            raise ValueError(f"window: expected an odd number of frames, got {window}")
        if motion < 4 or motion % 2:
            raise ValueError(f"motion: expected an even number of at least 4 channels, got {motion}")
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
        """Return all flows of every iteration, as training needs them.

        Args:
            spikes: (B, N, H, W), any real dtype.
            times: the first, the middle and the last time point, in spike frames.
            pattern: Bayer phase.

        Returns:
            A flow :math:`(4, B, 2, 3, 2, h, w)` in Bayer cells for every iteration. Its axes are the sites, the clips,
            to the first and to the last time point, a third, two thirds and all of the way, and x and y.
        """
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        first, middle, last = times
        end = spikes.shape[1] - 1
        backwards = self._windows(spikes.flip(1), end - middle, end - first, pattern)
        windows = torch.stack([backwards, self._windows(spikes, middle, last, pattern)], dim=2)
        # large clips stream by stream: every position takes memory for all that is looked up
        few = max(1, _PIXELS // (windows.shape[-2] * windows.shape[-1]))
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            parts = [self.network(part, self.iterations) for part in windows.flatten(0, 2).split(few)]
        return [torch.cat(flows).unflatten(0, windows.shape[:3]) for flows in zip(*parts, strict=True)]

    def _windows(self, spikes: Tensor, middle: int, last: int, pattern: str) -> Tensor:
        """Windows of intervals from the middle on, (4, B, 4, window, h, w)."""
        intervals = split_any_size(spike_interval(spikes).to(next(self.parameters()).dtype), pattern)
        centers = torch.tensor([round(middle + (last - middle) * k / 3) for k in range(4)])
        frames = centers[:, None] + torch.arange(self.window) - self.window // 2
        return intervals[:, :, frames.clamp(0, spikes.shape[1] - 1).to(spikes.device)]
