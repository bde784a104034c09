"""Motion without weights: Lucas and Kanade's, on decoded pictures."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightning_modules.motion.estimator import MotionEstimator, split_any_size
from spikekit import tfp, upsample_flow
from spikekit.check import check_planes

_BLUR = 0.5  # of the pictures, in Bayer cells


class ClassicalFlow(MotionEstimator):
    r"""Iterative Lucas-Kanade (scikit-image) on decoded pictures: no weights, runs on the CPU.

    The clip is decoded in its middle and a quarter of it before and after, by means of third order that see nearly all
    of it, see :func:`spikekit.tfp`: noise harms Lucas and Kanade's estimate more than what moves meanwhile. The flows
    are then stretched to the times that are asked for, as motion is taken to be linear. Each 2 x 2 Bayer cell is
    averaged to one grey pixel, so that the noise of the four colours is averaged *before* motion is estimated;
    averaging four flows afterwards, as eq. (7) does with a learned estimator, was less accurate here and four times
    the work. Of scikit-image's two estimators this one bears the noise better than TV-L1; kornia has no dense flow
    estimator without weights.

    Args:
        radius: of the Gaussian-weighted window, in Bayer cells.

    Shape:
        As :class:`MotionEstimator`; no gradient.

    Example:
        >>> to_first, to_last = ClassicalFlow()(torch.ones(1, 41, 16, 16), (5, 20, 35), "RGGB")
        >>> to_first.shape, to_last.abs().max().item()
        (torch.Size([1, 2, 16, 16]), 0.0)

    Reference:
        Le Besnerais and Champagnat, Dense optical flow by iterative local window registration, ICIP 2005.
    """

    def __init__(self, radius: int = 10) -> None:
        super().__init__()
        if radius < 1:
            raise ValueError(f"radius: expected 1 or more, got {radius}")
        self.radius = radius

    @torch.no_grad()
    def channel_flows(  # noqa: D102
        self, spikes: Tensor, times: tuple[int, int, int], pattern: str
    ) -> tuple[Tensor, Tensor]:
        sites, stretch = self._decode(spikes, times, pattern)
        flows = self._estimate(sites.flatten(0, 1))
        return tuple(by * flow.unflatten(0, sites.shape[:2]) for flow, by in zip(flows, stretch, strict=True))

    @torch.no_grad()
    def forward(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:  # noqa: D102
        height, width = spikes.shape[-2:]
        sites, stretch = self._decode(spikes, times, pattern)
        flows = self._estimate(sites.mean(dim=0))
        return tuple(by * upsample_flow(flow, 2)[..., :height, :width] for flow, by in zip(flows, stretch, strict=True))

    @staticmethod
    def _decode(spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, tuple[float, float]]:
        """Three pictures of every sub-stream, (4, B, 3, h, w), and what stretches their flows to the times."""
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        frames, (first, middle, last) = spikes.shape[1], times
        window, away = 2 * max((frames - 1) // 6, 1) + 1, max(frames // 4, 1)
        seen = [max(middle - away, 0), middle, min(middle + away, frames - 1)]
        pictures = split_any_size(tfp(spikes, window, order=3, dtype=torch.float32)[:, seen], pattern)
        # where the mean is cut by the ends of the clip, it stands for a later or an earlier time
        clock = torch.arange(frames, dtype=torch.float64).reshape(-1, 1, 1)
        before, now, after = tfp(clock, window, order=3)[seen].flatten().tolist()
        stretch = (first - middle) / (before - now), (last - middle) / (after - now)
        return pictures, stretch

    def _estimate(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Flows from the middle one of three grey pictures, (B, 3, h, w), to the others, each (B, 2, h, w)."""
        from skimage.filters import gaussian
        from skimage.registration import optical_flow_ilk

        def estimate(middle: np.ndarray, other: np.ndarray) -> Tensor:
            down, right = optical_flow_ilk(middle, other, radius=self.radius, gaussian=True, dtype=np.float32)
            return torch.from_numpy(np.stack([right, down]))

        clips = gaussian(pictures.cpu().numpy(), (0, 0, _BLUR, _BLUR), mode="nearest")
        to_first, to_last = (torch.stack([estimate(clip[1], clip[i]) for clip in clips]) for i in (0, 2))
        return to_first.to(pictures.device), to_last.to(pictures.device)

    def extra_repr(self) -> str:  # noqa: D102
        return f"radius={self.radius}"
