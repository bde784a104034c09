"""Motion fields: the joint flow of the four colours, upsampling, and linear motion."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spikekit.check import check_planes, check_whole
from spikekit.options_module import OptionsModule


def _check_flow(name: str, flow: Tensor) -> None:
    check_planes(name, flow, 3, "(*, 2, H, W)", floating=True)
    if flow.shape[-3] != 2:
        raise ValueError(f"{name}: expected (*, 2, H, W), got {tuple(flow.shape)}")


def ends(flow: Tensor) -> tuple[Tensor, Tensor]:
    """Return the columns and the rows, (*, H, W), at which the flow (*, 2, H, W) of every pixel ends."""
    rows, columns = (torch.arange(side, device=flow.device, dtype=flow.dtype) for side in flow.shape[-2:])
    return flow[..., 0, :, :] + columns, flow[..., 1, :, :] + rows[:, None]


def ends_inside(flow: Tensor, beyond: float = 0.0) -> Tensor:
    """Return a mask (*, H, W) of the pixels whose flow (*, 2, H, W) ends inside, or ``beyond`` pixels outside."""
    height, width = flow.shape[-2:]
    x, y = ends(flow)
    return (x >= -beyond) & (x <= width - 1 + beyond) & (y >= -beyond) & (y <= height - 1 + beyond)


def joint_flow(flows: Tensor | Sequence[Tensor]) -> Tensor:
    r"""Average the flows estimated from the sub-streams R, G1, G2 and B.

    .. math:: w = \frac{1}{4} \sum_{C \in \{R, G_1, G_2, B\}} w^C

    Convention:
        The colours are the **first** axis, as in :func:`spikekit.split_bayer`; any number of flows is accepted. The
        result has the resolution of the input flows, and is in their pixels. The four positions in a Bayer cell average
        to its centre, where :func:`upsample_flow` expects them. Linear, and differentiable as such.

    Args:
        flows: (C, \*, 2, H, W), or a sequence of C flows (\*, 2, H, W); any C of at least one.

    Returns:
        (\*, 2, H, W), in the dtype of ``flows``.

    Raises:
        TypeError: a flow is not a floating-point tensor.
        ValueError: there are no flows, their sizes differ, or they do not have two channels.

    Example:
        >>> joint_flow([torch.zeros(1, 2, 4, 4), torch.ones(1, 2, 4, 4)]).unique().item()
        0.5

    Reference:
        Dong et al., CVPR 2024, eq. (7).
    """
    if not isinstance(flows, Tensor):
        if not isinstance(flows, Iterable):
            raise TypeError(f"flows: expected a tensor (C, *, 2, H, W) or a sequence of flows, got {flows!r}")
        flows = list(flows)
        if not flows:
            raise ValueError("flows: expected at least one flow, got none")
        for flow in flows:
            _check_flow("flows", flow)
        if len({flow.shape for flow in flows}) > 1:
            raise ValueError(f"flows: expected one size, got {[tuple(flow.shape) for flow in flows]}")
        flows = torch.stack(flows)
    _check_flow("flows", flows)
    if flows.ndim < 4 or flows.shape[0] == 0:
        raise ValueError(f"flows: expected (C, *, 2, H, W) with at least one flow, got {tuple(flows.shape)}")
    return flows.mean(dim=0)


class JointFlow(nn.Module):
    r"""See the Convention block on :func:`joint_flow`.

    Shape:
        - Input: :math:`(C, *, 2, H, W)`
        - Output: :math:`(*, 2, H, W)`

    Example:
        >>> JointFlow()(torch.zeros(4, 1, 2, 8, 8)).shape
        torch.Size([1, 2, 8, 8])
    """

    def forward(self, flows: Tensor | Sequence[Tensor]) -> Tensor:  # noqa: D102
        return joint_flow(flows)


def upsample_flow(flow: Tensor, scale: int) -> Tensor:
    r"""Upsample flow bilinearly to a finer grid, and multiply it by ``scale``.

    .. math:: w'(x, y) = s \, w \Bigl(\frac{x + 1/2}{s} - \frac{1}{2}, \frac{y + 1/2}{s} - \frac{1}{2}\Bigr)

    Convention:
        A coarse pixel is the block of ``scale`` x ``scale`` fine ones that begins at (scale x, scale y)
        (``align_corners=False``), as in :func:`spikekit.bayer_mask` and :func:`spikekit.bin_to_sensor`. Outside the
        outermost coarse centres the nearest flow is repeated. Linear in the flow, and differentiable as such. Scale 1
        returns the input flow.

    Args:
        flow: :math:`(*, 2, H, W)`, floating.
        scale: upsampling factor.

    Returns:
        :math:`(*, 2, scale \cdot H, scale \cdot W)`, in the dtype of ``flow``.

    Raises:
        TypeError: ``flow`` is not a floating-point tensor.
        ValueError: ``flow`` does not have two channels, or ``scale`` is not a whole number >= 1.

    Example:
        >>> upsample_flow(torch.ones(1, 2, 2, 2), 4).unique().item()
        4.0
    """
    _check_flow("flow", flow)
    scale = check_whole("scale", scale)
    return flow if scale == 1 else _upsample(flow, scale).to(flow.dtype)


def _upsample(flow: Tensor, scale: int) -> Tensor:
    """Upsample in float32 or wider, so that half precision is rounded only once, at the end."""
    planes = flow.reshape(-1, *flow.shape[-3:]).to(torch.promote_types(flow.dtype, torch.float32))
    if scale > 1:
        height, width = planes.shape[-2:]
        size = scale * height, scale * width  # torch.compile does not accept a dynamic scale factor
        planes = F.interpolate(scale * planes, size=size, mode="bilinear", align_corners=False)
    return planes.reshape(*flow.shape[:-2], *planes.shape[-2:])


class UpsampleFlow(OptionsModule):
    r"""See the Convention block on :func:`upsample_flow`.

    Shape:
        - Input: :math:`(*, 2, H, W)`
        - Output: :math:`(*, 2, scale \cdot H, scale \cdot W)`

    Example:
        >>> UpsampleFlow(2)(torch.zeros(2, 5, 7)).shape
        torch.Size([2, 10, 14])
    """

    def __init__(self, scale: int) -> None:
        super().__init__()
        self.scale = check_whole("scale", scale)

    def forward(self, flow: Tensor) -> Tensor:  # noqa: D102
        return upsample_flow(flow, self.scale)


def linear_motion(
    flow_to_first: Tensor,
    flow_to_last: Tensor,
    times: Sequence[float],
    *,
    first: float | None = None,
    middle: float | None = None,
    last: float | None = None,
    scale: int = 1,
) -> Tensor:
    r"""Displacement of every pixel of the middle frame at each time, if motion is linear on both sides of it.

    .. math::
        o_t = s \cdot \begin{cases}
            \frac{t - j}{i - j} \, w_{j,i} & t < j \\
            \frac{t - j}{k - j} \, w_{j,k} & t \ge j
        \end{cases}

    Convention:
        i, j, k are the times of the first, the middle and the last frame between which the flows were estimated. The
        offset at j is zero; times before i or after k are extrapolated. The flow is first upsampled by ``scale``, see
        :func:`upsample_flow`. Linear in both flows, and differentiable as such. Backward sampling, as in
        :func:`spikekit.flow_warp` and :func:`spikekit.flow_warp_idw`: the pixel (x, y) of the middle frame is at
        (x, y) + offset at time t.

    Args:
        flow_to_first: :math:`w_{j,i}`, :math:`(*, 2, H, W)`.
        flow_to_last: :math:`w_{j,k}`, of the same size.
        times: T times, in the unit of ``first`` and ``last``, such as spike frames.
        first: i; default: the first of ``times``.
        middle: j; default: half way between ``first`` and ``last``.
        last: k; default: the last of ``times``.
        scale: super-resolution factor s.

    Returns:
        The offsets :math:`(*, T, 2, s \cdot H, s \cdot W)` in pixels of the fine grid, in the dtype of the flows.

    Raises:
        TypeError: the flows are not floating-point tensors, or the times are not numbers.
        ValueError: the flows differ in size or do not have two channels, there are no times, first < middle < last does
            not hold, or ``scale`` is below 1.

    Example:
        >>> to_first, to_last = torch.full((1, 2, 1, 1), -2.0), torch.full((1, 2, 1, 1), 4.0)
        >>> linear_motion(to_first, to_last, [5, 8, 20, 35])[0, :, 0].flatten().tolist()
        [-2.0, -1.6..., 0.0, 4.0]

    Reference:
        Dong et al., CVPR 2024, eq. (8).
    """
    _check_flow("flow_to_first", flow_to_first)
    _check_flow("flow_to_last", flow_to_last)
    if flow_to_first.shape != flow_to_last.shape:
        first, last = tuple(flow_to_first.shape), tuple(flow_to_last.shape)
        raise ValueError(f"flow_to_first, flow_to_last: expected one size, got {first} and {last}")
    times, first, middle, last = _check_times(times, first, middle, last)
    scale = check_whole("scale", scale)
    to_first, to_last = _upsample(flow_to_first, scale), _upsample(flow_to_last, scale)
    offsets = [
        to_first * ((t - middle) / (first - middle)) if t < middle else to_last * ((t - middle) / (last - middle))
        for t in times
    ]
    return torch.stack(offsets, dim=-4).to(torch.promote_types(flow_to_first.dtype, flow_to_last.dtype))


def _check_times(
    times: Sequence[float], first: float | None, middle: float | None, last: float | None
) -> tuple[list[float], float, float, float]:
    """Return the checked times, with defaults filled in."""
    try:
        times = [float(t) for t in times]
    except (TypeError, ValueError):
        raise TypeError(f"times: expected numbers, got {times!r}") from None
    if not times:
        raise ValueError("times: expected at least one time, got none")
    first = times[0] if first is None else first
    last = times[-1] if last is None else last
    middle = (first + last) / 2 if middle is None else middle
    if not first < middle < last:
        raise ValueError(f"first, middle, last: expected increasing times, got {first}, {middle}, {last}")
    return times, first, middle, last


class LinearMotion(OptionsModule):
    r"""See the Convention block on :func:`linear_motion`.

    Shape:
        - Input: two flows :math:`(*, 2, H, W)`
        - Output: :math:`(*, T, 2, scale \cdot H, scale \cdot W)`

    Example:
        >>> LinearMotion(range(5, 36, 3), scale=4)(torch.zeros(1, 2, 8, 8), torch.zeros(1, 2, 8, 8)).shape
        torch.Size([1, 11, 2, 32, 32])
    """

    def __init__(
        self,
        times: Sequence[float],
        *,
        first: float | None = None,
        middle: float | None = None,
        last: float | None = None,
        scale: int = 1,
    ) -> None:
        super().__init__()
        times, self.first, self.middle, self.last = _check_times(times, first, middle, last)
        self.times, self.scale = tuple(times), check_whole("scale", scale)

    def forward(self, flow_to_first: Tensor, flow_to_last: Tensor) -> Tensor:  # noqa: D102
        options = {name: getattr(self, name) for name in ("first", "middle", "last", "scale")}
        return linear_motion(flow_to_first, flow_to_last, self.times, **options)
