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

_GRAIN = 1e-4  # grain that a network leaves as well, in units of a white pixel
_REMOVED = 0.4  # share of a pixel's own noise that smoothing removes
_LEVELS = 1024  # how finely the noise of the sensor is tabulated


class Activity(NamedTuple):
    """Statistics of clips, cell by cell, summed over sensor pixels, in units of a squared white pixel.

    Args:
        smooth: ``rgb`` :math:`(B, 3, H, W)`, the smoothed mean of all frames.
        texture: what smoothing takes away from the mean, :math:`(B, h, w)`.
        grain: noise of the mean, as far as a network would average it away, likewise.
        change: from the beginning of the clip to its end, likewise.
        area: sensor pixels of the cells, likewise.
    """

    smooth: Tensor
    texture: Tensor
    grain: Tensor
    change: Tensor
    area: Tensor


class Look(NamedTuple):
    """Statistics of clips, cell by cell.

    Args:
        picture: smooth ``rgb`` :math:`(B, 3, s H, s W)`, all that flat parts need.
        flat: squared error that a cell gets where ``picture`` stands for the network's, :math:`(B, h, w)`, summed over
            its sensor pixels; a white pixel is 1.
        still: likewise, where the network is told that nothing moves; at most ``flat``.
        error: squared error of the network itself, :math:`(B)`, summed over the clip.
    """

    picture: Tensor
    flat: Tensor
    still: Tensor
    error: Tensor


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
    r"""Measure texture, grain and motion of clips.

    Two weighted sums over the frames contain nearly all of it: the mean light of every pixel, and its change from
    beginning to end. Texture is what smoothing removes from the mean; grain, the noise of the mean, is large where it
    is dark. Both and the change count only as far as they exceed what an ideal sensor shows of constant light. More
    noise, as from a real sensor, looks like texture and motion, and goes through the network.

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
    texture, grain = (_sum(part).clamp(min=0) / alpha**2 for part in (texture, grain))
    grain = (grain - _GRAIN * area).clamp(min=0)
    motion = (_sum((change.square() - jitter) * trust) / _sum(trust)).clamp(min=0) * area / alpha**2
    return Activity(rgb / alpha, *(part[:, 0] for part in (texture, grain, motion, area)))


def look(spikes: Tensor, scale: int, pattern: str, alpha: float, model: ErrorModel | None = None) -> Look:
    """Analyse clips: what every part of the picture would lose by less work.

    Args:
        spikes: :math:`(B, N, H, W)`, zeros and ones, any real dtype.
        scale: super-resolution factor s.
        pattern: Bayer phase.
        alpha: light of a white pixel per clock, in thresholds.
        model: constants of the network that the work is spared, ``network.error_model``; careful ones when not given.

    Returns:
        What was seen, in cells of ``CELL`` sensor pixels, those at the right and at the bottom cut off.

    Raises:
        ValueError: not (B, N, H, W).

    Example:
        >>> seen = look(torch.ones(1, 41, 20, 40), scale=2, pattern="RGGB", alpha=1.0)
        >>> seen.picture.shape, seen.flat.shape, bool(seen.picture.sub(1).abs().max() < 1e-5)
        (torch.Size([1, 3, 40, 80]), torch.Size([1, 2, 3]), True)
    """
    seen = scene_activity(spikes, pattern, alpha)
    flat, still, error = expected_errors(seen, ErrorModel() if model is None else model)
    rgb = seen.smooth
    if scale > 1:
        with torch.autocast(spikes.device.type, enabled=False):
            rgb = F.interpolate(rgb, scale_factor=scale, mode="bicubic", align_corners=False)
    return Look(rgb, flat, still, error.sum(dim=(1, 2)))


def expected_errors(seen: Activity, model: ErrorModel) -> tuple[Tensor, Tensor, Tensor]:
    """Squared errors that statistics let expect, :math:`(B, h, w)` each.

    Args:
        seen: the statistics.
        model: constants of a network.

    Returns:
        What the smooth picture adds, what a network adds that is told that nothing moves, at most as much, and what the
        network leaves itself.
    """
    flat = model.flat * seen.texture + model.grainy * seen.grain + model.blurred * seen.change
    error = model.textured * seen.texture + model.moved * seen.change + model.faint * seen.area
    return flat, torch.minimum(model.still * seen.change, flat), error


def required(seen: Look, tolerance: float) -> tuple[Tensor, Tensor]:
    r"""Which cells need the network, and which of them its motion.

    Work that adds least to the squared error is skipped first, until the PSNR of the whole picture is expected to have
    fallen by the tolerance:

    .. math:: \Delta E \le (10^{tolerance / 10} - 1) \, E

    So a larger tolerance never needs more work. For several clips, the most demanding one decides.

    Args:
        seen: by :func:`look`.
        tolerance: in dB, above 0.

    Returns:
        ``network`` and ``motion``, booleans (h, w) on the CPU; motion only where the network is.

    Example:
        >>> seen = look(torch.ones(1, 41, 32, 32), scale=2, pattern="RGGB", alpha=1.0)
        >>> [cells.any().item() for cells in required(seen, 0.1)]
        [False, False]
    """
    flat, still = seen.flat.flatten(1), seen.still.flatten(1)
    added, order = torch.cat([still, flat], dim=1).sort(dim=1)
    spent = torch.cat([still, flat - still], dim=1).gather(1, order).cumsum(dim=1)
    fits = spent <= (10 ** (tolerance / 10) - 1) * seen.error[:, None]
    # everything that adds less than the first that does not fit
    limit = added.where(~fits, torch.inf).amin(dim=1)[:, None, None]
    network, motion = (cells.ge(limit).any(dim=0).cpu() for cells in (seen.flat, seen.still))
    return network, motion


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
