"""The sensor: pixels that integrate light and fire one-bit spikes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from spikekit.check import check_planes, check_positive


# A custom operator, because torch.compile would unroll the loop over time and because the gradient does not need it.
@torch.library.custom_op("spikekit::integrate_fire", mutates_args=())
def _integrate_fire(light: Tensor, threshold: float, charge: Tensor) -> tuple[Tensor, Tensor]:
    spikes = torch.empty_like(light)
    charge = charge.clone()
    theta = charge.new_tensor(threshold)  # a tensor: CUDA would divide by a number through its inverse
    for light_t, spike_t in zip(light.unbind(-3), spikes.unbind(-3), strict=True):
        charge += light_t
        whole = torch.floor(charge / theta)
        spike_t.copy_(whole > 0)
        charge -= whole * theta
        charge.clamp_(min=0)  # the quotient may have been rounded up to a whole number
    return spikes, charge


@_integrate_fire.register_fake
def _(light: Tensor, threshold: float, charge: Tensor) -> tuple[Tensor, Tensor]:
    return torch.empty_like(light), torch.empty_like(charge)


def _save_light(ctx: Any, inputs: tuple[Tensor, float, Tensor], output: Any) -> None:
    light, ctx.threshold, _ = inputs
    ctx.save_for_backward(light)


def _straight_through(ctx: Any, grad_spikes: Tensor, _: Tensor) -> tuple[Tensor, None, None]:
    (light,) = ctx.saved_tensors
    linear = (light >= 0) & (light <= ctx.threshold)
    return torch.where(linear, grad_spikes / ctx.threshold, 0), None, None


_integrate_fire.register_autograd(_straight_through, setup_context=_save_light)


def spike_integrate_fire(light: Tensor, threshold: float = 1.0, charge: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Integrate light at every pixel and fire a spike whenever the charge reaches the threshold.

    .. math::
        u_t = c_{t-1} + I_t, \quad k_t = \lfloor u_t / \theta \rfloor, \quad
        S_t = [k_t > 0], \quad c_t = u_t - k_t \theta

    Convention:
        Time is axis -3. Light is the charge that arrives per clock, in the unit of the threshold, and is not negative.
        A pixel fires at :math:`u \ge \theta` and is reset by subtraction. The read-out is one bit: surplus whole
        thresholds within one clock are lost, not remembered. The charge goes in and comes out, so that a recording
        cut into chunks equals one run, bit for bit. It is held in float32 or wider, whatever the dtype of the light.

        The gradient is straight-through in the linear range,
        :math:`\partial S_t / \partial I_t = 1 / \theta` where :math:`0 \le I_t \le \theta`, else 0, which makes the
        gradient of a spike count that of the light. The charge that comes out is state and carries no gradient.

    Args:
        light: charge per sensor clock, :math:`(*, T, H, W)`, floating, >= 0.
        threshold: charge of one spike.
        charge: charge at the start, broadcastable to :math:`(*, H, W)`, in [0, threshold); zero when not given.

    Returns:
        The spikes, zeros and ones in the shape and dtype of ``light``, and the charge left, :math:`(*, H, W)`.

    Raises:
        TypeError: ``light`` or ``charge`` is not a floating-point tensor.
        ValueError: fewer than three dimensions, a charge that does not fit, a threshold that is not above 0.

    Example:
        >>> light = torch.full((5, 1, 1), 0.5)
        >>> spikes, charge = spike_integrate_fire(light)
        >>> spikes.flatten().tolist(), charge.item()
        ([0.0, 1.0, 0.0, 1.0, 0.0], 0.5)
        >>> again, _ = spike_integrate_fire(light, charge=charge)  # the next chunk
        >>> again.flatten().tolist()
        [1.0, 0.0, 1.0, 0.0, 1.0]

    Reference:
        Dong et al., CVPR 2024, eq. (1)-(3).
    """
    check_planes("light", light, 3, "(*, T, H, W)", floating=True)
    check_positive("threshold", threshold)
    planes = light.shape[:-3] + light.shape[-2:]
    dtype = torch.promote_types(light.dtype, torch.float32)
    if charge is None:
        charge = light.new_zeros(planes, dtype=dtype)
    else:
        check_planes("charge", charge, 2, "(*, H, W)", floating=True)
        try:
            charge = charge.detach().to(torch.promote_types(dtype, charge.dtype)).expand(planes)
        except RuntimeError:
            raise ValueError(f"charge: expected {tuple(planes)}, got {tuple(charge.shape)}") from None
    spikes, charge = _integrate_fire(light, float(threshold), charge)
    return spikes, charge.detach()


class SpikeIntegrateFire(nn.Module):
    r"""See the Convention block on :func:`spike_integrate_fire`.

    Shape:
        - Input: light :math:`(*, T, H, W)` and, optionally, charge :math:`(*, H, W)`
        - Output: spikes :math:`(*, T, H, W)` and charge :math:`(*, H, W)`

    Example:
        >>> spikes, charge = SpikeIntegrateFire(threshold=2.0)(torch.rand(41, 8, 8))
        >>> spikes.shape, charge.shape
        (torch.Size([41, 8, 8]), torch.Size([8, 8]))
    """

    def __init__(self, threshold: float = 1.0) -> None:
        super().__init__()
        check_positive("threshold", threshold)
        self.threshold = threshold

    def forward(self, light: Tensor, charge: Tensor | None = None) -> tuple[Tensor, Tensor]:  # noqa: D102
        return spike_integrate_fire(light, self.threshold, charge)

    def extra_repr(self) -> str:  # noqa: D102
        return f"threshold={self.threshold}"
