"""Flicker, a metric for films."""

from __future__ import annotations

from torch import Tensor

from spikekit import flow_warp
from spikekit.flow.fields import ends_inside


def film_flicker(rgb: Tensor, then: Tensor, truth: Tensor, truth_then: Tensor, flow: Tensor) -> Tensor:
    r"""Measure flicker: the change in error between two pictures of a film, after warping along the true flow.

    .. math:: d = \sqrt{\operatorname{mean} \bigl( (W(\hat I_{then}) - \hat I) - (W(I_{then}) - I) \bigr)^2}

    Errors that move with the scene, such as constant blur, do not count; errors that come and go do. Pixels whose flow
    ends outside the picture are ignored.

    Args:
        rgb: pictures, :math:`(B, 3, H, W)`, in [0, 1].
        then: the next or previous pictures, :math:`(B, 3, H, W)`.
        truth: ground truth of ``rgb``.
        truth_then: ground truth of ``then``.
        flow: true flow from ``rgb`` to ``then``, :math:`(B, 2, H, W)`, in pixels of the pictures.

    Returns:
        Root mean square in steps of 8 bits, :math:`(B)`; lower is better. NaN if all flow ends outside the picture.

    Example:
        >>> import torch
        >>> truth, flow = torch.rand(1, 3, 8, 8), torch.zeros(1, 2, 8, 8)
        >>> film_flicker(truth + 0.1, truth + 0.1, truth, truth, flow).round(decimals=3).item()
        0.0
        >>> film_flicker(truth, truth + 1 / 255, truth, truth, flow).round(decimals=3).item()
        1.0

    Reference:
        Lai et al., Learning Blind Video Temporal Consistency, ECCV 2018.
    """
    inside = ends_inside(flow)
    error = (flow_warp(then - truth_then, flow) - (rgb - truth)).square().mean(dim=1)
    return 255 * ((error * inside).sum(dim=(1, 2)) / inside.sum(dim=(1, 2))).sqrt()
