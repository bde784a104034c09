"""Scene activity: texture and motion of a clip, cell by cell, measured before a network runs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from kornia.filters import filter2d_separable, get_gaussian_kernel1d
from torch import Tensor

from lightning_modules.storage.error_model import ErrorModel
from spikekit import bayer_mask
from spikekit.check import check_planes
from spikekit.sensor.quantization_noise import flicker

#: sensor pixels along the side of a cell, the smallest part that is looked at by itself
CELL = 16

_REMOVED = 0.4  # share of a pixel's own noise that smoothing removes
_LEVELS = 1024  # how finely the noise of the sensor is tabulated


class Activity(NamedTuple):
    """Statistics of clips, cell by cell, (B, h, w) each, summed over sensor pixels; a white pixel is 1.

    Args:
        texture: what smoothing takes away from the mean over time, squared.
        change: from the beginning of the clip to its end, squared.
        area: sensor pixels of the cells.
    """

    texture: Tensor
    change: Tensor
    area: Tensor


@lru_cache(maxsize=4)
def _weights(frames: int) -> Tensor:
    """Two weighted sums over time, (2, N): the mean, and the change from the beginning to the end.

    Both begin and end at zero: an integrate-and-fire pixel rounds from spike to spike, and what it rounds away now it
    adds later, so that weights which change slowly cancel most of it. Equal weights leave five times the noise.
    """
    phase = 2 * math.pi * (torch.arange(frames) + 0.5) / frames
    return torch.stack([1 - phase.cos(), 2 * math.pi * phase.sin()]) / frames


@lru_cache(maxsize=4)
def _noise(frames: int) -> Tensor:
    """Variance of mean and change where light is constant, (2, levels), from black, which has none, to 1."""
    return flicker(_weights(frames), torch.linspace(0, 1, _LEVELS + 1))


def scene_activity(spikes: Tensor, pattern: str, alpha: float) -> Activity:
    r"""Measure texture and motion of clips.

    Two weighted sums over the frames contain nearly all of it: the mean light of every pixel, and its change from
    beginning to end. Texture is what smoothing removes from the mean. Both count only as far as they exceed what an
    ideal sensor shows of constant light. More noise, as from a real sensor, looks like texture and motion.

    Args:
        spikes: :math:`(B, N, H, W)`, zeros and ones, any real dtype.
        pattern: Bayer phase.
        alpha: light of a white pixel per clock, in thresholds.

    Returns:
        What was measured, in cells of ``CELL`` sensor pixels, those at the right and at the bottom cut off.

    Raises:
        ValueError: not (B, N, H, W).
    """
    check_planes("spikes", spikes, 4, "(B, N, H, W)")
    with torch.autocast(spikes.device.type, enabled=False):
        return _scene_activity(spikes, pattern, alpha)


def _scene_activity(spikes: Tensor, pattern: str, alpha: float) -> Activity:
    frames, height, width = spikes.shape[-3:]
    light, change = torch.einsum("kn,bnhw->kbhw", _weights(frames).to(spikes.device), spikes.float()).unsqueeze(2)
    mask = bayer_mask(height, width, pattern, device=spikes.device, dtype=light.dtype)
    rgb, wide = _smooth(light, mask, 1.0), _smooth(light, mask, 2.0)

    table = _noise(frames).to(spikes.device)
    level = _level((wide * mask).sum(dim=1, keepdim=True))
    grain, jitter = table[0][level], table[1][level]
    texture = (light - (rgb * mask).sum(dim=1, keepdim=True)).square() - _REMOVED * grain
    # pixels that rest are trusted more; in the dark, or near a third of the threshold, a pixel beats slowly by itself
    around = F.max_pool1d(table[1:], _LEVELS // 16 + 1, 1, _LEVELS // 32)[0]
    trust = 1 / (around[_level(light)] + 1e-3 * alpha**2)

    area = _sum(torch.ones_like(light))
    texture = _sum(texture).clamp(min=0) / alpha**2
    change = (_sum((change.square() - jitter) * trust) / _sum(trust)).clamp(min=0) * area / alpha**2
    return Activity(*(part[:, 0] for part in (texture, change, area)))


def expected_errors(seen: Activity, model: ErrorModel) -> tuple[Tensor, Tensor]:
    """Return squared errors that statistics let expect, (B, h, w) each.

    Args:
        seen: the statistics.
        model: constants of a network.

    Returns:
        What a network adds that is told that nothing moves, and what it leaves otherwise.
    """
    left = model.textured * seen.texture + model.moved * seen.change + model.faint * seen.area
    return model.still * seen.change, left


def moving_cells(still: Tensor, error: Tensor, tolerance: float) -> Tensor:
    r"""Return which cells need their motion.

    That of the cells that lose least without it is left out first, until the PSNR of the whole picture is expected to
    have fallen by the tolerance:

    .. math:: \Delta E \le (10^{tolerance / 10} - 1) \, E

    So a larger tolerance never needs more work. For several clips, the most demanding one decides.

    Args:
        still: squared error that is added without motion, (B, h, w).
        error: squared error of the network itself, likewise.
        tolerance: in dB, above 0.

    Returns:
        Booleans (h, w) on the CPU.

    Example:
        >>> moving_cells(torch.tensor([[[0.0, 1.0, 0.1]]]), torch.ones(1, 1, 3), 0.2)
        tensor([[False,  True, False]])
    """
    added = still.flatten(1).sort(dim=1).values
    fits = added.cumsum(dim=1) <= (10 ** (tolerance / 10) - 1) * error.flatten(1).sum(dim=1, keepdim=True)
    # everything that adds less than the first that does not fit
    limit = added.where(~fits, torch.inf).amin(dim=1)[:, None, None]
    return still.ge(limit).any(dim=0).cpu()


def _smooth(light: Tensor, mask: Tensor, sigma: float) -> Tensor:
    """Gaussian mean of the known pixels of every colour: (B, 1, H, W) to (B, 3, H, W)."""
    kernel = get_gaussian_kernel1d(2 * math.ceil(3 * sigma) + 1, sigma, device=light.device, dtype=light.dtype)
    known = torch.cat([light * mask, mask[None]])
    blurred = filter2d_separable(known, kernel, kernel, border_type="constant")
    return blurred[:-1] / blurred[-1:]


def _level(light: Tensor) -> Tensor:
    """Place of light in the table of noise."""
    return (light * _LEVELS).round().long().clamp(0, _LEVELS)


def _sum(plane: Tensor) -> Tensor:
    """Sums over cells: (B, 1, H, W) to (B, 1, h, w)."""
    return F.avg_pool2d(plane, CELL, ceil_mode=True, divisor_override=1)
