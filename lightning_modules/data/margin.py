"""The margin around a training patch, whose spikes serve only to estimate motion."""

from __future__ import annotations

from torch import Tensor


def flow_margin(patch: int, flow_patch: int) -> int:
    """Return the even margin around a patch that lets motion be estimated on at least ``flow_patch`` pixels.

    Example:
        >>> flow_margin(24, 48), flow_margin(26, 48), flow_margin(96, 48)
        (12, 12, 0)
    """
    return 2 * max(0, -((patch - flow_patch) // 4))


def trim(planes: Tensor, margin: int) -> Tensor:
    """Crop a margin: (*, H, W) to (*, H - 2 margin, W - 2 margin)."""
    height, width = planes.shape[-2:]
    return planes[..., margin : height - margin, margin : width - margin]
