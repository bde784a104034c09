"""Estimators of motion: from a clip of spikes to the flows from its middle to its first and last time point."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spikekit import split_bayer, tfi, upsample_flow
from spikekit.check import check_planes


class MotionEstimator(nn.Module):
    r"""Base of the estimators.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, any real dtype; the times of the first, the middle and the last time
          point, in spike frames; the Bayer phase
        - Output: two flows :math:`(B, 2, H, W)` in sensor pixels, middle to first and middle to last
    """

    def forward(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:
        """Estimate the two flows."""
        raise NotImplementedError


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
    def forward(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:  # noqa: D102
        from skimage.registration import optical_flow_ilk

        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        height, width = spikes.shape[-2:]
        decoded = tfi(spikes)[:, list(times)].float()
        # mirrored without repeating the border, which keeps the Bayer phase
        decoded = F.pad(decoded, (0, width % 2, 0, height % 2), "reflect")
        grey = split_bayer(decoded, pattern).mean(dim=0).cpu().numpy()

        def estimate(middle: np.ndarray, other: np.ndarray) -> Tensor:
            down, right = optical_flow_ilk(middle, other, radius=self.radius, gaussian=True, dtype=np.float32)
            return torch.from_numpy(np.stack([right, down]))

        flows = [torch.stack([estimate(clip[1], clip[i]) for clip in grey]) for i in (0, 2)]
        to_first, to_last = (upsample_flow(flow, 2)[..., :height, :width].to(spikes.device) for flow in flows)
        return to_first, to_last

    def extra_repr(self) -> str:  # noqa: D102
        return f"radius={self.radius}"


class ZeroFlow(MotionEstimator):
    r"""Nothing moves.

    Shape:
        As :class:`MotionEstimator`.

    Example:
        >>> ZeroFlow()(torch.ones(1, 41, 16, 16), (5, 20, 35), "RGGB")[0].any().item()
        False
    """

    def forward(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:  # noqa: D102
        zero = spikes.new_zeros(spikes.shape[0], 2, *spikes.shape[-2:], dtype=torch.float32)
        return zero, zero
