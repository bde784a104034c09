"""Metrics for optical flow: end-point error and outliers."""

from __future__ import annotations

from torch import Tensor


def end_point_error(flow: Tensor, truth: Tensor) -> Tensor:
    r"""Return the distance between the end points of a flow and the true flow, per pixel.

    .. math:: e = \sqrt{(u - u^*)^2 + (v - v^*)^2}

    Args:
        flow: estimated flow, (\*, 2, H, W), in pixels.
        truth: true flow of the same shape, in the same pixels.

    Returns:
        Error (\*, H, W), in the same pixels.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> import torch
        >>> end_point_error(torch.zeros(2, 1, 1), torch.tensor([3.0, 4.0]).reshape(2, 1, 1)).item()
        5.0

    Reference:
        Baker et al., A Database and Evaluation Methodology for Optical Flow, IJCV 2011.
    """
    if flow.shape != truth.shape:
        raise ValueError(f"flow, truth: expected equal shapes, got {tuple(flow.shape)} and {tuple(truth.shape)}")
    return (flow - truth).norm(dim=-3)


def outliers(error: Tensor, truth: Tensor) -> Tensor:
    r"""Return the outliers as KITTI defines them: errors above three pixels and five per cent of the true flow.

    Args:
        error: end-point error, (\*, H, W), see :func:`end_point_error`.
        truth: true flow, (\*, 2, H, W), in the same pixels.

    Returns:
        Boolean mask (\*, H, W).

    Example:
        >>> import torch
        >>> truth = torch.tensor([100.0, 0.0]).reshape(2, 1, 1)
        >>> [outliers(torch.full((1, 1), error), truth).item() for error in (4.0, 6.0)]
        [False, True]

    Reference:
        Menze and Geiger, Object Scene Flow for Autonomous Vehicles, CVPR 2015.
    """
    return (error > 3) & (error > 0.05 * truth.norm(dim=-3))
