"""Dead and hot pixels of a clip of any scene: find them, and fill them from their neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from spikekit.check import check_planes
from spikekit.color.cfa import GREY, cfa_pattern

_LEAST_SPIKES = 3  # spikes of the neighbours, below which a silent pixel is not called dead

#: gain below which a pixel is dead, relative to others, and rate of a saturated pixel, in spikes per clock
DEAD_GAIN, ALWAYS = 0.1, 0.99


def find_outliers(count: Tensor, frames: int, pattern: str | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Find dead and hot pixels by comparison with their eight nearest neighbours of the same colour.

    Convention:
        A pixel is dead if it fires less than a tenth as often as the second darkest neighbour, which fires at least
        three times. It is hot if it fires at nearly every clock, and the second brightest neighbour at less than half.
        One neighbour may thus be a defect as well, and a line one pixel wide is none. Pictures are mirrored at borders.

    Args:
        count: spikes of each pixel, :math:`(*, H, W)`.
        frames: clocks that were counted.
        pattern: Bayer phase; ``None`` for a grey sensor.

    Returns:
        dead and hot pixels, as masks :math:`(*, H, W)`, and the index, in a flattened picture, of the neighbour of
        each pixel with the median count, :math:`(*, H, W)`.
    """
    step = 1 if pattern in (None, GREY) else 2
    height, width = count.shape[-2:]
    rows, columns = (_mirrored(size, step, count.device) for size in (height, width))
    index = (rows[:, None, :, None] * width + columns[None, :, None, :]).flatten(0, 1)
    index = torch.cat([index[:4], index[5:]])
    near, which = count.flatten(-2)[..., index].sort(-3)
    darkest, brightest = near[..., 1, :, :], near[..., 6, :, :]
    dead = (darkest >= _LEAST_SPIKES) & (count < DEAD_GAIN * darkest)
    hot = (count >= ALWAYS * frames) & (brightest < 0.5 * frames)
    return dead, hot, index.expand(near.shape).gather(-3, which[..., 3:4, :, :]).squeeze(-3)


def fill_defects(spikes: Tensor, pattern: str | None = None) -> Tensor:
    """Give dead and hot pixels the spikes of a neighbour of their colour: that with the median count of the eight.

    A clip is enough: neither a calibration nor a still scene is needed. The defects are those of
    :func:`spikekit.calibration.defects.find_outliers`.

    Args:
        spikes: zeros and ones, :math:`(*, T, H, W)`.
        pattern: Bayer phase; ``None`` or ``"grey"`` for a grey sensor.

    Returns:
        Spikes of the same shape and dtype; those of other pixels are unchanged. A gradient goes to the pixel that a
        spike is from.

    Raises:
        TypeError: ``spikes`` is not a tensor of real numbers.
        ValueError: ``spikes`` has fewer than three dimensions, or ``pattern`` is unknown.

    Example:
        >>> spikes = torch.ones(12, 5, 5, dtype=torch.uint8)
        >>> spikes[1::2] = 0
        >>> spikes[:, 2, 3] = 0  # dead
        >>> fill_defects(spikes)[:, 2, 3].tolist()
        [1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0]
    """
    check_planes("spikes", spikes, 3, "(*, T, H, W)")
    pattern = pattern and cfa_pattern(pattern)
    dead, hot, other = find_outliers((spikes != 0).sum(-3, dtype=torch.int32), spikes.shape[-3], pattern)
    return replace_pixels(spikes, dead | hot, other)


def replace_pixels(spikes: Tensor, bad: Tensor, other: Tensor) -> Tensor:
    """Give bad pixels (*, H, W) the spikes (*, T, H, W) of others, see :func:`find_outliers`."""
    own = torch.arange(bad.shape[-2] * bad.shape[-1], device=spikes.device).reshape(bad.shape[-2:])
    source = torch.where(bad, other, own).flatten(-2).unsqueeze(-2)
    pixels = spikes.flatten(-2)
    return pixels.gather(-1, source.expand(pixels.shape)).reshape(spikes.shape)


def _mirrored(size: int, step: int, device: torch.device) -> Tensor:
    """Return the indices ``step`` before, at and after each, mirrored at the ends, or its own, (3, size)."""
    own = torch.arange(size, device=device)
    shifted = own + torch.tensor([[-step], [0], [step]], device=device)
    mirrored = (size - 1) - ((size - 1) - shifted.abs()).abs()
    return torch.where(mirrored < 0, own, mirrored)
