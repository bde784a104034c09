"""Metrics of optical flow: end-point error and outliers."""

from __future__ import annotations

from torch import Tensor


def end_point_error(flow: Tensor, truth: Tensor) -> Tensor:
    r"""Distance between where a flow and the true one end, pixel by pixel.

    .. math:: e = \sqrt{(u - u^*)^2 + (v - v^*)^2}

    Args:
        flow: (\*, 2, H, W), in any pixels.
        truth: of the same size, in the same pixels.

    Returns:
        (\*, H, W), in those pixels.

    Raises:
        ValueError: sizes that differ.

    Example:
        >>> import torch
        >>> end_point_error(torch.zeros(2, 1, 1), torch.tensor([3.0, 4.0]).reshape(2, 1, 1)).item()
        5.0

    Reference:
        Baker et al., A Database and Evaluation Methodology for Optical Flow, IJCV 2011.
    """
    if flow.shape != truth.shape:
        raise ValueError(f"flow, truth: expected one size, got {tuple(flow.shape)} and {tuple(truth.shape)}")
    return (flow - truth).norm(dim=-3)


def outliers(error: Tensor, truth: Tensor) -> Tensor:
    r"""Where flow is wrong as KITTI counts it: by more than three pixels and more than five per cent of the truth.

    Args:
        error: :func:`end_point_error`, (\*, H, W).
        truth: (\*, 2, H, W), in the same pixels.

    Returns:
        (\*, H, W), bool.

    Example:
        >>> import torch
        >>> truth = torch.tensor([100.0, 0.0]).reshape(2, 1, 1)
        >>> [outliers(torch.full((1, 1), error), truth).item() for error in (4.0, 6.0)]
        [False, True]

    Reference:
        Menze and Geiger, Object Scene Flow for Autonomous Vehicles, CVPR 2015.
    """
    return (error > 3) & (error > 0.05 * truth.norm(dim=-3))
