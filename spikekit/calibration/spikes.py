"""Convert the spikes of a real sensor to those of an ideal one."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from spikekit.calibration.calibration import Calibration
from spikekit.check import check_planes, default_float
from spikekit.decoders.dense import tfi
from spikekit.sensor.integrate_fire import spike_integrate_fire

_GOLDEN = (math.sqrt(5) - 1) / 2
_ROUNDING = 1e-4  # tolerance for rounding errors in sums of light, in thresholds


def correct_spikes(spikes: Tensor, calibration: Calibration | None, pattern: str | None = None) -> Tensor:
    r"""Return the spikes that an ideal sensor would have fired, for networks, which take spikes rather than light.

    .. math:: \hat I_n = \text{corrected } 1 / \Psi_n, \quad \hat S = \text{spikes of } \hat I

    Convention:
        The light at every clock is that of :func:`spikekit.tfi`, which integrates to one threshold between two spikes.
        It is corrected by :meth:`Calibration.correct` and fed to :func:`spikekit.spike_integrate_fire`. The initial
        charge reproduces the first spike of each pixel. A pixel that needs no correction keeps its spikes, bit for bit;
        a dead or hot one fires according to the mean light of its neighbours. Only pixels that keep their spikes pass
        their gradient.

    Args:
        spikes: zeros and ones, :math:`(*, T, H, W)`.
        calibration: the calibration of the sensor; ``None`` for an ideal one, whose spikes are returned.
        pattern: Bayer phase; ``None`` for a grey sensor.

    Returns:
        Zeros and ones of the same shape and dtype.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: ``spikes`` has fewer than three dimensions, or not the size of the calibration.

    Example:
        >>> spikes = torch.tensor([0, 1, 0, 0, 1, 0, 0, 1, 0, 0]).reshape(10, 1, 1)
        >>> sensor = Calibration(torch.full((1, 1), 0.5), torch.zeros(1, 1), torch.zeros(1, 1, dtype=torch.uint8))
        >>> correct_spikes(spikes, sensor).flatten().tolist()
        [1, 1, 0, 1, 1, 0, 1, 1, 0, 1]
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    if calibration is None:
        return spikes
    fired = spikes != 0
    light = calibration.correct(tfi(fired, dtype=torch.promote_types(default_float(spikes), torch.float32)), pattern)
    first = fired.byte().argmax(-3, keepdim=True)
    until = light.cumsum(-3).gather(-3, first).squeeze(-3)
    charge = (1 - until + _ROUNDING) % 1
    place = torch.arange(charge.shape[-2] * charge.shape[-1], device=spikes.device).reshape(charge.shape[-2:])
    filled = (calibration.defects != 0).to(spikes.device)
    charge = torch.where(filled, place * _GOLDEN % 1, charge)
    again, _ = spike_integrate_fire(light, charge=charge, dtype=torch.uint8)
    return torch.where(calibration.ideal.to(spikes.device), spikes, again.to(spikes.dtype))
