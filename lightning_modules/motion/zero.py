"""Zero motion, the lower bound in comparisons."""

from __future__ import annotations

import torch
from torch import Tensor

from lightning_modules.motion.estimator import MotionEstimator
from spikekit.color.cfa import cfa_sites


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
