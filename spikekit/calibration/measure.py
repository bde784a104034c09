"""Measure the pixels of a sensor from dark and flat recordings, or find defects in any scene."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spikekit.calibration.calibration import Calibration
from spikekit.calibration.defects import ALWAYS, DEAD_GAIN, find_outliers
from spikekit.calibration.pixel_rates import PixelRates
from spikekit.color.cfa import GREY, bayer_mask
from spikekit.sensor.noise import DEAD, HOT

_HOT_RATE = 0.5  # dark rate from which on a pixel is hot, in spikes per clock
_LIT_RATE = 0.1  # median rate that dark current does not reach: published sensors have 0.005 at 20 kHz


class Measured(NamedTuple):
    """A calibration and the standard errors of gain and dark rate per pixel; ``None`` if not measured."""

    calibration: Calibration
    gain_error: float | None = None
    dark_error: float | None = None


def calibrate(
    flat: tuple[PixelRates, PixelRates] | None,
    dark: tuple[PixelRates, PixelRates] | None,
    pattern: str | None = None,
) -> Measured:
    r"""Measure the pixels from recordings of even light and of darkness.

    .. math:: d = r_\text{dark}, \quad g = \frac{r_\text{flat} - d}{\mathrm{E}_C (r_\text{flat} - d)}

    Convention:
        The mean is over the working pixels of a colour. A pixel is hot if it fires in half of the dark clocks or in
        nearly all of the flat ones, and dead if its gain is less than a tenth of the others'. Without a dark recording,
        dark rates are 0; without a flat one, gains are 1.

        The standard error is half the root mean square difference between the two halves of a recording. This is exact
        for shot noise, and an upper bound for light that arrives evenly.

    Raises:
        ValueError: the flat recording is less than twice as bright as the dark one, or its pixels are saturated; or
            there is none, and most pixels of the dark one fire in more than a tenth of the clocks.
    """
    size = tuple((flat or dark)[0].count.shape)
    leak, gain = torch.zeros(size, dtype=torch.float64), torch.ones(size, dtype=torch.float64)
    defects = torch.zeros(size, dtype=torch.uint8)
    gain_error = dark_error = None
    if dark is not None:
        leak = (dark[0] + dark[1]).rate
        if flat is None and (rate := leak.median().item()) > _LIT_RATE:
            raise ValueError(f"expected a dark recording, at most {_LIT_RATE} spikes per clock, got {rate:.3g}")
        defects[leak >= _HOT_RATE] = HOT
        dark_error = _error(dark[0].rate, dark[1].rate, defects == 0)
    if flat is not None:
        whole = flat[0] + flat[1]
        brightness = whole.rate.median().item()
        if brightness >= ALWAYS:
            raise ValueError(f"expected a flat recording without saturation, got {brightness:.3g} per clock")
        light = whole.rate - leak
        if light.median() <= brightness / 2:
            rates = f"{brightness:.3g} and {leak.median():.3g} spikes per clock"
            raise ValueError(f"expected a flat recording more than twice as bright as the dark one, got {rates}")
        defects[whole.rate >= ALWAYS] = HOT
        errors = []
        for pixels in bayer_mask(*size, pattern or GREY, dtype=torch.bool):
            works = pixels & (defects == 0)
            defects[works & (light < DEAD_GAIN * light[works].median())] = DEAD
            works = pixels & (defects == 0)
            mean = light[works].mean()
            gain[works] = light[works] / mean
            errors.append(_error(flat[0].rate, flat[1].rate, works) / mean.item())
        gain_error = float(np.mean(errors))
    leak[defects != 0] = 0
    return Measured(Calibration(gain.float(), leak.float(), defects), gain_error, dark_error)


def _error(one: Tensor, other: Tensor, works: Tensor) -> float:
    """Return the standard error of the mean of two halves."""
    return (one - other)[works].square().mean().sqrt().item() / 2


def find_defects(scene: PixelRates, pattern: str | None = None) -> Measured:
    """Find dead and hot pixels in a recording of any scene, see :func:`spikekit.calibration.defects.find_outliers`.

    Gains stay 1: in a still scene they cannot be separated from texture; for a moving one, see
    :func:`spikekit.calibration.in_motion.calibrate_in_motion`.
    """
    dead, hot, _ = find_outliers(scene.count, scene.frames, pattern)
    size = tuple(scene.count.shape)
    return Measured(Calibration(torch.ones(size), torch.zeros(size), dead.byte() * DEAD + hot.byte() * HOT))
