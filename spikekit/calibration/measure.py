"""Measure the pixels of a sensor from dark and flat recordings, or find defects in any scene."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spikekit.calibration.calibration import Calibration
from spikekit.calibration.pixel_rates import PixelRates
from spikekit.color.cfa import GREY, bayer_mask
from spikekit.sensor.noise import DEAD, HOT

_LEAST_SPIKES = 10  # spikes of the neighbours, below which a silent pixel is not called dead
_DEAD_GAIN = 0.1  # gain below which a pixel is dead, relative to others
_HOT_RATE = 0.5  # dark rate from which on a pixel is hot, in spikes per clock
_ALWAYS = 0.99  # rate of a saturated pixel, in spikes per clock

_NEAR = 5  # side of the neighbourhood, in pixels of the same colour


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
        ValueError: the flat recording is not brighter than the dark one, or its pixels are saturated.
    """
    size = tuple((flat or dark)[0].count.shape)
    leak, gain = torch.zeros(size, dtype=torch.float64), torch.ones(size, dtype=torch.float64)
    defects = torch.zeros(size, dtype=torch.uint8)
    gain_error = dark_error = None
    if dark is not None:
        leak = (dark[0] + dark[1]).rate
        defects[leak >= _HOT_RATE] = HOT
        dark_error = _error(dark[0].rate, dark[1].rate, defects == 0)
    if flat is not None:
        whole = flat[0] + flat[1]
        brightness = whole.rate.median().item()
        if brightness >= _ALWAYS:
            raise ValueError(f"expected a flat recording without saturation, got {brightness:.3g} per clock")
        light = whole.rate - leak
        if light.median() <= 0:
            raise ValueError(f"expected a flat recording brighter than the dark one, got {brightness:.3g} per clock")
        defects[whole.rate >= _ALWAYS] = HOT
        errors = []
        for pixels in bayer_mask(*size, pattern or GREY, dtype=torch.bool):
            works = pixels & (defects == 0)
            defects[works & (light < _DEAD_GAIN * light[works].median())] = DEAD
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
    """Find dead and hot pixels in a recording of any scene, by comparison with their neighbours.

    Convention:
        A pixel is compared with the median of its neighbours of the same colour. It is dead if it fires less than a
        tenth as often, provided that they fire at least ten times. It is hot if it fires at nearly every clock, and
        they at less than half. Gains stay 1: in a still scene they cannot be separated from texture; for a moving one,
        see :func:`spikekit.calibration.in_motion.calibrate_in_motion`.
    """
    size = tuple(scene.count.shape)
    defects = torch.zeros(size, dtype=torch.uint8)
    step = 1 if pattern is None else 2
    for row, column in np.ndindex(min(step, size[0]), min(step, size[1])):  # pixels of one colour
        place = slice(row, None, step), slice(column, None, step)
        rate = scene.rate[place]
        around = _median_around(rate)
        dead = (around * scene.frames >= _LEAST_SPIKES) & (rate < _DEAD_GAIN * around)
        hot = (rate >= _ALWAYS) & (around < 0.5)
        defects[place] = dead.byte() * DEAD + hot.byte() * HOT
    return Measured(Calibration(torch.ones(size), torch.zeros(size), defects))


def _median_around(plane: Tensor) -> Tensor:
    """Return the median over a window without its centre."""
    from scipy.ndimage import rank_filter

    others = np.arange(_NEAR**2).reshape(_NEAR, _NEAR) != _NEAR**2 // 2
    return torch.from_numpy(rank_filter(plane.numpy(), _NEAR**2 // 2 - 1, footprint=others, mode="nearest"))
