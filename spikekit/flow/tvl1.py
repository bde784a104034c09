"""TV-L1 optical flow between two times, for pictures of known noise."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.kernels import TRITON, gpu_kernel, import_loops
from spikekit.kernels.graphs import Replayed
from spikekit.warp import flow_warp

SMOOTHINGS, ROUNDS = 2, 10  # smoothing steps per round, and rounds per warp
COUPLING = 0.25  # theta, which couples the data term and the smooth flow
STEP = 0.15  # step of the dual variable; must be below 1/4 to converge

_SMALLEST = 16  # shorter side of the coarsest level, in pixels
_COARSE = 2  # further linearizations on all levels but the finest, where they cost little


@torch.no_grad()
def tvl1_flow(
    pictures: Tensor,
    times: Tensor,
    attachment: Tensor,
    start: Tensor | None = None,
    warps: int = 5,
) -> Tensor:
    r"""Estimate the motion v between two times of a scene: :math:`I_0(x + t_0 v) = I_1(x + t_1 v)`.

    It minimises :math:`\int |\nabla v_x| + |\nabla v_y| + \lambda |I_1(x + t_1 v) - I_0(x + t_0 v)|` from coarse to
    fine. The data term is linearised around the current v, and both terms are solved alternately, coupled by
    :math:`\theta = 0.25`. The times 0 and 1 give optical flow from the first picture to the second, -1/2 and 1/2 the
    motion at the time between.

    Args:
        pictures: (B, 2, H, W), finite, of at least 2 x 2 pixels, float32 or wider.
        times: (B, 2), :math:`t_0` and :math:`t_1`, about 1 apart.
        attachment: (B, H, W), the weight :math:`\lambda` of the data term.
        start: initial flow (B, 2, H, W), refined at full size only; default: 0 at the coarsest size.
        warps: number of linearizations at full size; smaller sizes take two more.

    Returns:
        (B, 2, H, W), in pixels per unit of the times, order (x, y).

    Reference:
        Zach, Pock and Bischof, A duality based approach for realtime TV-L1 optical flow, DAGM 2007.
    """
    given = [part for part in (pictures, times.to(pictures), attachment, start) if part is not None]
    return (_replayed if pictures.is_cuda else _estimate)(warps, *given)


def _estimate(warps: int, pictures: Tensor, times: Tensor, attachment: Tensor, start: Tensor | None = None) -> Tensor:
    sizes = [pictures.shape[-2:]]
    while start is None and min(sizes[-1]) >= 2 * _SMALLEST:
        sizes.append(tuple((side + 1) // 2 for side in sizes[-1]))
    levels = [torch.cat([pictures, attachment[:, None]], dim=1)]
    for smaller in sizes[1:]:
        levels.append(F.interpolate(levels[-1], smaller, mode="bilinear", antialias=True))
    flow = pictures.new_zeros(len(pictures), 2, *sizes[-1]) if start is None else start
    for level in reversed(levels):
        if flow.shape[-2:] != level.shape[-2:]:
            (height, width), (old_height, old_width) = level.shape[-2:], flow.shape[-2:]
            flow = F.interpolate(flow, level.shape[-2:], mode="bilinear")
            flow = torch.stack([flow[:, 0] * (width / old_width), flow[:, 1] * (height / old_height)], dim=1)
        more = 0 if level is levels[0] else _COARSE
        flow = _improve(level[:, :2], times, level[:, 2] * COUPLING, flow, warps + more)
    return flow


#: on a GPU, launches take longer than the work, so they are replayed
_replayed = Replayed(_estimate)


def _improve(pictures: Tensor, times: Tensor, limit: Tensor, flow: Tensor, warps: int) -> Tensor:
    if pictures.is_cuda and pictures.dtype is torch.float32 and TRITON:
        constants = ROUNDS, SMOOTHINGS, STEP, STEP / COUPLING
        return gpu_kernel("tvl1_level")(pictures, times, limit, flow, warps, *constants)
    compiled = import_loops("spikekit.flow.cpu_tvl1") if pictures.device.type == "cpu" else None
    return (refine if compiled is None else compiled.refine)(pictures, times, limit, flow, warps)


def refine(pictures: Tensor, times: Tensor, limit: Tensor, flow: Tensor, warps: int) -> Tensor:
    """Refine the flow (B, 2, H, W) of a level; ``limit`` (B, H, W) bounds each data step, in slopes."""
    time = times.to(pictures)[..., None, None, None]
    height, width = flow.shape[-2:]
    # dual variable per component and direction, padded by zeros at the top and left
    dual = flow.new_zeros(*flow.shape[:2], 2, height + 1, width + 1)
    inner, ahead = dual[..., 1:, 1:], torch.zeros_like(dual[..., 1:, 1:])
    for _ in range(warps):
        moved = flow_warp(pictures.unsqueeze(2), flow.unsqueeze(1) * time).squeeze(2)
        slopes = torch.stack(torch.gradient(moved, dim=(-1, -2)), dim=2) * time
        slope = slopes[:, 1] - slopes[:, 0]
        rest = moved[:, 1] - moved[:, 0] - (slope * flow).sum(dim=1)
        square = slope.square().sum(dim=1).neg_() - 1e-30
        for _ in range(ROUNDS):
            differs = torch.addcmul(rest, slope[:, 0], flow[:, 0]).addcmul_(slope[:, 1], flow[:, 1])
            near = torch.addcmul(flow, differs.div_(square).clamp_(-limit, limit).unsqueeze(1), slope)
            flow = near + _divergence(dual)
            for _ in range(SMOOTHINGS):
                torch.sub(flow[..., 1:], flow[..., :-1], out=ahead[:, :, 0, :, :-1])
                torch.sub(flow[..., 1:, :], flow[..., :-1, :], out=ahead[:, :, 1, :-1])
                share = torch.hypot(*ahead.unbind(2)).mul_(STEP / COUPLING).add_(1)
                inner.add_(ahead, alpha=STEP).div_(share.unsqueeze(2))
                flow = _divergence(dual).add_(near)
    return flow


def _divergence(dual: Tensor) -> Tensor:
    to_right, down = dual.unbind(dim=2)
    return (to_right[..., 1:, 1:] - to_right[..., 1:, :-1]).add_(down[..., 1:, 1:]).sub_(down[..., :-1, 1:])
