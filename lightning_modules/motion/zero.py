"""Zero motion, the lower bound of every comparison."""

from __future__ import annotations

import torch
from torch import Tensor

from lightning_modules.motion.estimator import MotionEstimator


class ZeroFlow(MotionEstimator):
    r"""Nothing moves.

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
        height, width = spikes.shape[-2:]
        zero = spikes.new_zeros(4, len(spikes), 2, (height + 1) // 2, (width + 1) // 2, dtype=torch.float32)
        return zero, zero
