"""Motion without weights: Lucas and Kanade's, on decoded pictures."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightning_modules.motion.estimator import MotionEstimator, split_any_size
from spikekit import tfi, upsample_flow
from spikekit.check import check_planes


class ClassicalFlow(MotionEstimator):
    r"""Iterative Lucas-Kanade (scikit-image) on decoded pictures: no weights, runs on the CPU.

    The clip is decoded by TFI at the three times, and each 2 x 2 Bayer cell is averaged to one grey pixel, so that the
    noise of the four colours is averaged *before* motion is estimated; averaging four flows afterwards, as eq. (7)
    does with a learned estimator, was less accurate here and four times the work. TFI needs no window, which would
    reach over the ends of the clip and shift the time that it stands for. Of scikit-image's two estimators this one
    bears the noise better than TV-L1; kornia has no dense flow estimator without weights.

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
        sites = self._decode(spikes, times, pattern)
        flows = self._estimate(sites.flatten(0, 1))
        return tuple(flow.unflatten(0, sites.shape[:2]) for flow in flows)

    @torch.no_grad()
    def forward(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:  # noqa: D102
        height, width = spikes.shape[-2:]
        flows = self._estimate(self._decode(spikes, times, pattern).mean(dim=0))
        return tuple(upsample_flow(flow, 2)[..., :height, :width] for flow in flows)

    @staticmethod
    def _decode(spikes: Tensor, times: tuple[int, int, int], pattern: str) -> Tensor:
        """Pictures of the sub-streams at the three times: (4, B, 3, h, w)."""
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        return split_any_size(tfi(spikes)[:, list(times)].float(), pattern)

    def _estimate(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Flows from the middle one of three grey pictures, (B, 3, h, w), to the others, each (B, 2, h, w)."""
        from skimage.registration import optical_flow_ilk

        def estimate(middle: np.ndarray, other: np.ndarray) -> Tensor:
            down, right = optical_flow_ilk(middle, other, radius=self.radius, gaussian=True, dtype=np.float32)
            return torch.from_numpy(np.stack([right, down]))

        clips = pictures.cpu().numpy()
        to_first, to_last = (torch.stack([estimate(clip[1], clip[i]) for clip in clips]) for i in (0, 2))
        return to_first.to(pictures.device), to_last.to(pictures.device)

    def extra_repr(self) -> str:  # noqa: D102
        return f"radius={self.radius}"
