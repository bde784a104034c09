"""The sensor: pixels that integrate light and fire one-bit spikes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from spikekit.check import check_dtype, check_planes, check_positive
from spikekit.kernels import operator
from spikekit.options_module import OptionsModule


# A custom operator, as torch.compile would unroll the loop over time and the gradient does not need it.
@operator(lambda light, threshold, charge, dtype: (torch.empty_like(light, dtype=dtype), torch.empty_like(charge)))
def _integrate_fire(light: Tensor, threshold: float, charge: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    spikes = torch.empty_like(light, dtype=dtype)
    theta = charge.new_tensor(threshold)  # a tensor, as CUDA divides by a number through its reciprocal
    for light_t, spike_t in zip(light.unbind(-3), spikes.unbind(-3), strict=True):
        full = charge + light_t
        fired = full >= theta
        spike_t.copy_(fired)
        rest = torch.where(fired, full - theta, full)
        # More than one threshold: drop the surplus, and a remainder that is out of range by rounding.
        remainder = full - torch.floor(full / theta) * theta
        remainder = torch.where((remainder >= 0) & (remainder < theta), remainder, 0)
        charge = torch.where(rest >= theta, remainder, rest)
    return spikes, charge


class _StraightThrough(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(light: Tensor, threshold: float, charge: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        return _integrate_fire(light, threshold, charge, dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        light, ctx.threshold, *_ = inputs
        ctx.save_for_backward(light)
        ctx.mark_non_differentiable(output[1])

    @staticmethod
    def backward(ctx: Any, grad_spikes: Tensor, _: Tensor) -> tuple[Tensor, None, None, None]:
        (light,) = ctx.saved_tensors
        wide = torch.promote_types(light.dtype, torch.float32)
        theta = light.new_tensor(ctx.threshold, dtype=wide)
        linear = (light.to(wide) >= 0) & (light.to(wide) <= theta)
        # no product, as 0 times infinity is NaN
        return torch.where(linear, grad_spikes.to(wide) / theta, 0).to(grad_spikes.dtype), None, None, None


def spike_integrate_fire(
    light: Tensor, threshold: float = 1.0, charge: Tensor | None = None, *, dtype: torch.dtype | None = None
) -> tuple[Tensor, Tensor]:
    r"""Integrate light at every pixel and fire a spike whenever the charge reaches the threshold.

    .. math::
        u_t = c_{t-1} + I_t, \quad k_t = \lfloor u_t / \theta \rfloor, \quad
        S_t = [k_t > 0], \quad c_t = u_t - k_t \theta

    Convention:
        Time is axis -3. Light is the charge that arrives per clock, in the unit of the threshold. A pixel fires at
        :math:`u \ge \theta` and is reset by subtraction. The read-out is one bit: surplus whole thresholds within one
        clock are lost, not remembered. The charge is an input and an output, so a recording processed in chunks equals
        one run, bit for bit. It is held in float32 or wider, whatever the dtype of the light, and stays below the
        threshold: a remainder outside [0, threshold) by rounding counts as 0.

        Negative light, a result of interpolation or noise, lowers the charge below 0, and later light makes up for it
        first; k is 0 there. After infinite light the pixel fires and is empty. Light that is NaN or minus infinity
        silences its pixel from then on, which shows in the charge.

        The gradient is straight-through in the linear range,
        :math:`\partial S_t / \partial I_t = 1 / \theta` where :math:`0 \le I_t \le \theta`, else 0. The gradient of a
        spike count is therefore that of the accumulated light. The returned charge has no gradient.

    Args:
        light: charge per sensor clock, :math:`(*, T, H, W)`, floating, >= 0.
        threshold: charge of one spike.
        charge: initial charge, broadcastable to :math:`(*, H, W)`, below the threshold; default: 0.
        dtype: dtype of the spikes; default: that of ``light``. ``torch.uint8`` and ``torch.bool`` take one byte per
            spike, without a gradient.

    Returns:
        The spikes, zeros and ones in the shape of ``light``, and the remaining charge, :math:`(*, H, W)`.

    Raises:
        TypeError: ``light`` or ``charge`` is not a floating-point tensor, or ``dtype`` is not floating, uint8 or bool.
        ValueError: ``light`` has fewer than three dimensions, ``charge`` has another size, or ``threshold`` is not
            above 0 or not representable in the dtype of the charge.

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
    check_dtype(dtype, torch.uint8, torch.bool)
    planes = light.shape[:-3] + light.shape[-2:]
    wide = torch.promote_types(light.dtype, torch.float32)
    if charge is None:
        charge = light.new_zeros(planes, dtype=wide)
    else:
        check_planes("charge", charge, 2, "(*, H, W)", floating=True)
        try:
            charge = charge.detach().to(torch.promote_types(wide, charge.dtype)).expand(planes)
        except RuntimeError:
            raise ValueError(f"charge: expected {tuple(planes)}, got {tuple(charge.shape)}") from None
    if not torch.finfo(charge.dtype).tiny <= threshold <= torch.finfo(charge.dtype).max:
        raise ValueError(f"threshold: expected a number that {charge.dtype} can hold, got {threshold}")
    return _StraightThrough.apply(light, float(threshold), charge, dtype or light.dtype)


class SpikeIntegrateFire(OptionsModule):
    r"""See the Convention block on :func:`spike_integrate_fire`.

    Shape:
        - Input: light :math:`(*, T, H, W)` and, optionally, charge :math:`(*, H, W)`
        - Output: spikes :math:`(*, T, H, W)` and charge :math:`(*, H, W)`

    Example:
        >>> spikes, charge = SpikeIntegrateFire(threshold=2.0)(torch.rand(41, 8, 8))
        >>> spikes.shape, charge.shape
        (torch.Size([41, 8, 8]), torch.Size([8, 8]))
    """

    def __init__(self, threshold: float = 1.0, *, dtype: torch.dtype | None = None) -> None:
        super().__init__()
        check_positive("threshold", threshold)
        check_dtype(dtype, torch.uint8, torch.bool)
        self.threshold, self.dtype = threshold, dtype

    def forward(self, light: Tensor, charge: Tensor | None = None) -> tuple[Tensor, Tensor]:  # noqa: D102
        return spike_integrate_fire(light, self.threshold, charge, dtype=self.dtype)
