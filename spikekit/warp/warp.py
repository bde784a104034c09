"""Warping of dense images and of sparse known pixels by optical flow."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spikekit.check import check_planes, check_whole
from spikekit.options_module import OptionsModule
from spikekit.warp.gather import Gather
from spikekit.warp.neighbors import finite, idw_neighbors


def _check_warp(name: str, image: Tensor, flow: Tensor) -> None:
    check_planes(name, image, 3, "(*, C, H, W)", floating=True)
    check_planes("flow", flow, 3, "(*, 2, H, W)", floating=True)
    if flow.shape[-3] != 2 or flow.shape[-2:] != image.shape[-2:] or flow.shape[:-3] != image.shape[:-3]:
        expected = (*image.shape[:-3], 2, *image.shape[-2:])
        raise ValueError(f"flow: expected {expected} for {name} {tuple(image.shape)}, got {tuple(flow.shape)}")


def flow_warp(image: Tensor, flow: Tensor) -> Tensor:
    r"""Warp an image by optical flow, with bilinear sampling.

    .. math:: O(x, y) = I(x + u(x, y), y + v(x, y))

    Convention:
        Flow in pixels, order (x, y), x right, y down. Pixel centres are at whole numbers; positions outside the image
        are clamped to its border. Coordinates are computed in float32 or wider. NaN flow counts as 0, infinite flow as
        very large, both with gradient 0. Built on :func:`kornia.geometry.transform.remap`. On a GPU, under
        ``torch.use_deterministic_algorithms(True)``, a gather is used instead: the result is the same up to rounding,
        gradients are deterministic, and second derivatives exist even if PyTorch's ``grid_sample`` lacks them.

    Args:
        image: :math:`(*, C, H, W)`, floating.
        flow: :math:`(*, 2, H, W)`.

    Returns:
        The warped image, of the shape and dtype of ``image``.

    Raises:
        TypeError: ``image`` or ``flow`` is not a floating-point tensor.
        ValueError: the sizes do not match.

    Example:
        >>> image = torch.tensor([[[[0.0, 1.0, 2.0, 3.0]]]])
        >>> flow_warp(image, torch.tensor([1.5, 0.0]).reshape(1, 2, 1, 1).expand(1, 2, 1, 4)).flatten().tolist()
        [1.5, 2.5, 3.0, 3.0]
    """
    _check_warp("image", image, flow)
    height, width = image.shape[-2:]
    wide = torch.promote_types(torch.promote_types(image.dtype, flow.dtype), torch.float32)
    planes = image.reshape(-1, *image.shape[-3:]).to(wide)
    x, y = finite(flow.reshape(-1, 2, height, width).to(wide)).unbind(1)
    x, y = x + torch.arange(width, device=flow.device), y + torch.arange(height, device=flow.device)[:, None]
    if image.is_cuda and torch.are_deterministic_algorithms_enabled():
        warped = _bilinear(planes, x, y)
    else:
        from kornia.geometry.transform import remap  # a quarter of a second

        warped = remap(planes, x, y, mode="bilinear", padding_mode="border", align_corners=True)
    return warped.to(image.dtype).reshape(image.shape)


def _bilinear(planes: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Compute the same as ``remap``, with deterministic derivatives of any order."""
    height, width = planes.shape[-2:]
    (left, right, share), (top, bottom, part) = _between(x, width), _between(y, height)
    index = torch.stack([row * width + column for row in (top, bottom) for column in (left, right)], dim=1)
    weight = torch.stack([v * h for v in (1 - part, part) for h in (1 - share, share)], dim=1)
    return Gather.apply(planes.flatten(2), index.flatten(2), weight.flatten(2)).reshape(planes.shape)


def _between(position: Tensor, length: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pixels before and after a position on an axis, and the weight of the latter."""
    inside = (position > 0) & (position < length - 1)
    position = torch.where(inside, position, position.detach().clamp(0, length - 1))  # no gradient at the border
    before = position.detach().floor()
    first = before.long()
    return first, (first + 1).clamp(max=length - 1), position - before


class FlowWarp(nn.Module):
    r"""See the Convention block on :func:`flow_warp`.

    Shape:
        - Input: image :math:`(*, C, H, W)` and flow :math:`(*, 2, H, W)`
        - Output: :math:`(*, C, H, W)`

    Example:
        >>> FlowWarp()(torch.rand(2, 3, 8, 8), torch.zeros(2, 2, 8, 8)).shape
        torch.Size([2, 3, 8, 8])
    """

    def forward(self, image: Tensor, flow: Tensor) -> Tensor:  # noqa: D102
        return flow_warp(image, flow)


def flow_warp_idw(features: Tensor, flow: Tensor, mask: Tensor, *, neighbors: int = 4) -> Tensor:
    r"""Warp sparse features by optical flow, interpolating the nearest known pixels by inverse distance.

    .. math::
        T(x, y) = \sum_{i=1}^{n} \frac{\phi_i}{\sum_j \phi_j} F(x_i, y_i), \quad
        \phi_i = \frac{1}{\sqrt{(x_m - x_i)^2 + (y_m - y_i)^2}}, \quad (x_m, y_m) = (x, y) + w(x, y)

    Convention:
        Flow in pixels, order (x, y), x right, y down. The neighbours are the exact nearest known pixels of any mask,
        also for positions outside the image; among equally distant ones the first in row-major order wins. If fewer
        than ``neighbors`` pixels are known, all are used. At a known pixel the result is that pixel. Positions are kept
        as a whole and a fractional part in float32 or wider, so they are as exact at column 4000 as at column 0, even
        in half precision.

        Unknown pixels are never read. Known pixels must be finite; otherwise results may be NaN even at other known
        pixels. NaN flow counts as 0, infinite flow as very large.

        Twice differentiable in the features and in the flow; the choice of neighbours is constant. At a known pixel,
        where the distance has a cone's tip, and at flow that is not finite, the gradient in the flow is 0.

        The search runs in Numba on a CPU, if installed (``pip install 'spikekit[fast]'``), in Triton on a GPU, and else
        in PyTorch. The neighbours are the same everywhere.

    Args:
        features: :math:`(*, C, H, W)`, floating.
        flow: :math:`(*, 2, H, W)`.
        mask: :math:`(H, W)`; a pixel is known where it is not 0. Tables of a mask are cached; on a GPU they are renewed
            when the version counter of the mask changes, which writing to ``mask.data`` does not do.
        neighbors: number of neighbours.

    Returns:
        The warped features, of the shape, dtype and memory layout of ``features``.

    Raises:
        TypeError: ``features`` or ``flow`` is not a floating-point tensor.
        ValueError: the sizes do not match, ``neighbors`` is below 1, or the mask has no known pixel.

    Example:
        >>> features = torch.tensor([[[[1.0, 0.0, 5.0, 0.0]]]])
        >>> known = torch.tensor([[1, 0, 1, 0]])
        >>> flow_warp_idw(features, torch.zeros(1, 2, 1, 4), known).flatten().tolist()
        [1.0, 3.0, 5.0, 4.0]

    Reference:
        Dong et al., CVPR 2024, eq. (9)-(10).
    """
    _check_warp("features", features, flow)
    height, width = features.shape[-2:]
    if not isinstance(mask, Tensor) or mask.shape != features.shape[-2:]:
        got = tuple(mask.shape) if isinstance(mask, Tensor) else type(mask).__name__
        raise ValueError(f"mask: expected {(height, width)} for features {tuple(features.shape)}, got {got}")
    neighbors = check_whole("neighbors", neighbors)
    dtype = torch.promote_types(features.dtype, flow.dtype)
    flow = flow.reshape(-1, 2, height, width).to(dtype)
    values = features.reshape(-1, features.shape[-3], height * width)
    index, weight = idw_neighbors(flow, mask, neighbors)
    return Gather.apply(values, index, weight).reshape(features.shape)


class FlowWarpIdw(OptionsModule):
    r"""See the Convention block on :func:`flow_warp_idw`.

    Shape:
        - Input: features :math:`(*, C, H, W)`, flow :math:`(*, 2, H, W)` and mask :math:`(H, W)`
        - Output: :math:`(*, C, H, W)`

    Example:
        >>> FlowWarpIdw()(torch.rand(2, 3, 8, 8), torch.zeros(2, 2, 8, 8), torch.ones(8, 8)).shape
        torch.Size([2, 3, 8, 8])
    """

    def __init__(self, *, neighbors: int = 4) -> None:
        super().__init__()
        self.neighbors = check_whole("neighbors", neighbors)

    def forward(self, features: Tensor, flow: Tensor, mask: Tensor) -> Tensor:  # noqa: D102
        return flow_warp_idw(features, flow, mask, neighbors=self.neighbors)
