"""Base class of the motion estimators, the joint flow of the four sub-streams, and the estimator for scenes at rest."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spikekit import joint_flow, split_bayer, upsample_flow
from spikekit.color.cfa import GREY, cfa_sites


class MotionEstimator(nn.Module):
    r"""Base class of motion estimators; subclasses implement :meth:`channel_flows`, and may override ``forward``.

    ``forward`` averages the flows of the four sub-streams, eq. (7), and enlarges the result to the sensor's resolution.
    A grey sensor has one sub-stream, with all of its pixels.

    Attributes:
        static: the flows are always zero, and networks do not call the estimator.

    Shape:
        - Input: spikes :math:`(B, N, H, W)` of any real dtype; the first, middle and last time points, in spike frames;
          the Bayer phase, or ``"grey"``
        - Output: two flows :math:`(B, 2, H, W)` in sensor pixels, middle to first and middle to last

    Reference:
        Dong et al., CVPR 2024, section 4.3, joint motion estimation.
    """

    static: bool = False

    def channel_flows(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:
        """Estimate the flows of each sub-stream separately.

        Args:
            spikes: (B, N, H, W), any real dtype.
            times: first, middle and last time points, in spike frames.
            pattern: Bayer phase, or ``"grey"``.

        Returns:
            Two flows (4, B, 2, h, w), middle to first and middle to last, in pixels of the sub-streams (Bayer cells);
            h and w are half of H and W, rounded up. Sub-streams are in the order of :func:`spikekit.split_bayer`. For
            a grey sensor, (1, B, 2, H, W).
        """
        raise NotImplementedError

    def forward(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:
        """Return the two flows, from the middle to the first and last time points."""
        height, width = spikes.shape[-2:]
        to_first, to_last = self.channel_flows(spikes, times, pattern)
        _, side = cfa_sites(pattern)
        return tuple(upsample_flow(joint_flow(flows), side)[..., :height, :width] for flows in (to_first, to_last))


def split_any_size(raw: Tensor, pattern: str) -> Tensor:
    """Split like :func:`spikekit.split_bayer`; odd sides are padded by reflection, which keeps the Bayer phase.

    (B, T, H, W) of at least 2 x 2 pixels becomes (4, B, T, h, w), with h and w half of H and W, rounded up;
    (1, B, T, H, W) for a grey sensor.
    """
    height, width = raw.shape[-2:]
    if min(height, width) < 2:
        raise ValueError(f"spikes: expected at least 2 x 2 pixels, got {height} x {width}")
    if pattern == GREY:
        return raw.unsqueeze(0)
    return split_bayer(F.pad(raw, (0, width % 2, 0, height % 2), "reflect"), pattern)


class ZeroFlow(MotionEstimator):
    r"""Estimator for scenes without motion; both flows are zero.

    Shape:
        As :class:`MotionEstimator`.

    Example:
        >>> ZeroFlow()(torch.ones(1, 41, 16, 16), (5, 20, 35), "RGGB")[0].any().item()
        False
    """

    static = True

    def channel_flows(  # noqa: D102
        self, spikes: Tensor, times: tuple[int, int, int], pattern: str
    ) -> tuple[Tensor, Tensor]:
        (height, width), (sites, side) = spikes.shape[-2:], cfa_sites(pattern)
        zero = spikes.new_zeros(len(sites), len(spikes), 2, -(-height // side), -(-width // side), dtype=torch.float32)
        return zero, zero
