"""Motion of the colours: joint flow (eq. 7), and the ablations D (independent) and E (assembled)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.motion import MotionEstimator
from spikekit import bayer_sites, merge_bayer


def joint_motion(motion: MotionEstimator, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> Tensor:
    """Estimate one flow for all colours, to the first and last time points, (B, 2, 2, H, W), in sensor pixels."""
    return torch.stack(motion(spikes, times, pattern), dim=1)


def independent_motion(motion: MotionEstimator, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> Tensor:
    """Estimate one flow per colour (ablation D), (B, 3, 2, 2, H, W); green takes the mean of its two sub-streams."""
    height, width = spikes.shape[-2:]
    red, *greens, blue = (
        _to_sensor(flow, row, column, height, width)
        for flow, (_, row, column) in zip(
            _channel_flows(motion, spikes, times, pattern), bayer_sites(pattern), strict=True
        )
    )
    return torch.stack([red, sum(greens) / 2, blue], dim=1)


def assembled_motion(motion: MotionEstimator, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> Tensor:
    """Interleave the flows of the four sub-streams as in the Bayer pattern (ablation E), (B, 2, 2, H, W)."""
    height, width = spikes.shape[-2:]
    return 2 * merge_bayer(_channel_flows(motion, spikes, times, pattern), pattern)[..., :height, :width]


def _channel_flows(motion: MotionEstimator, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> Tensor:
    """Return the two flows of each of the four sub-streams, (4, B, 2, 2, h, w), in Bayer cells."""
    flows = torch.stack(motion.channel_flows(spikes, times, pattern), dim=2)
    return flows.to(torch.promote_types(flows.dtype, torch.float32))


def _to_sensor(flow: Tensor, row: int, column: int, height: int, width: int) -> Tensor:
    """Resample a sub-stream's flow to the sensor; its pixel (i, j) is the sensor's (2 i + row, 2 j + column)."""
    flow, both = flow.flatten(0, 1), flow.shape[:2]
    flow = F.pad(flow, (column, 1 - column, row, 1 - row), mode="replicate")
    size = 2 * flow.shape[-2] - 1, 2 * flow.shape[-1] - 1
    flow = 2 * F.interpolate(flow, size, mode="bilinear", align_corners=True)  # keeps values, adds one between two
    return flow[..., row : row + height, column : column + width].unflatten(0, both)
