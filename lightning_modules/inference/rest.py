"""Parts of a film at rest: found by their spikes, and not computed again."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.inference.tiles import Box
from spikekit import Calibration, bin_to_sensor, demosaic

#: side of a cell, the smallest part that can rest, in sensor pixels
CELL = 8
#: margins around a box, in sensor pixels, for the network and for the estimate of motion
SEEN, AROUND = 2, 16

_RISK = 1e-5  # probability that a cell at rest counts as moved
_TESTS = 16  # tests per cell: single blocks of 1, 2 and 4 pixels, all of each size, and two with its neighbours
_DARK = 0.02  # spikes per clock and pixel of a cell that is dark
_PICTURES = 8  # pictures of the network that a cell at rest shows the mean of
_SURE = 160  # clocks without a change before the clip of a resting cell
_SURER = 640  # the same where half of the cells around, or a sixth of all, are not sure, and after a drift
_MORE = 1.25  # clocks, relative to those that a resting cell was drawn with, after which it is drawn again
_BUSY, _UNTESTED = 0.75, 8  # share of cells that makes a picture busy, and pictures after it that are not tested
_FADE = 0.96  # weight of the sums of squares of the previous key frame
_ALIKE = 1, 2, 4, 8  # key frames with much the same rounding of blocks of 1, 2, 4 and 8 pixels of even light
_WINDOWS = 0, 0, 5, 5, 3, 3, 3, 3  # sides in cells, averaged over twice, of steps towards a smooth gain; 0: of all
_SAME = 10  # weight of no change in these, relative to that of a spike more or less
_SOFT = 90  # by how much a smooth gain reduces the squares of a part of 8 x 8 cells
_LEAST = 1 / 12  # smallest variance of a count, as light is not known exactly
_DEEP = 3  # largest change of light by a lamp, in powers of two, as dark current does not follow it
_LEAK = 0.0047  # dark current at noise level 1, in spikes per clock, see configs/cameras.yaml
_NOISE = 0.001  # variance of the sensor per spike, besides rounding: 1000 electrons per threshold


def find_changes(
    recent: Tensor, reference: Tensor, share: Tensor | float, step: Tensor | float = 1.0, soft: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Find where a scene has changed between two counts of spikes, and by how much its light has.

    A pixel that integrates light l counts :math:`n l` spikes in n clocks, rounded up or down. With the fractional part
    f of :math:`n l`, the variance is :math:`f (1 - f)`, at most a quarter for any number of spikes. A reference of m
    clocks, with :math:`q = n / m`, predicts the count of an ideal sensor with

    .. math:: d = c - g q r, \quad \operatorname{var} d \approx f (1 - f) + \frac{q^2}{6} + \frac{q^2 + q}{4}

    where the second term is the error of f, and the last is the rounding of the reference, which is correlated with
    that of the next count. Sums of :func:`spikekit.tfi` also count parts of intervals. They are rounded to the light of
    a clock, l, and their variance is at most :math:`l^2 (1 + q + q^2) / 4`, which is much smaller.

    The gain g of flickering lamps is that of all cells, by robust least squares, or one that varies smoothly over the
    picture, by the same in windows, if this reduces the squares of a part of 8 x 8 cells by more than 90. A gain counts
    only if it reduces squares of cells, also of those at rest with it, by more than 25 in all, and if no more cells
    have moved with it than without.

    A cell has moved if the sum of :math:`d^2 / \operatorname{var}` over its K blocks of 1, 2, 4 or 8 pixels exceeds
    :math:`K + 2 \sqrt{K x} + 2 x` with :math:`x = \ln(\text{tests} / \text{risk})`, which K normal numbers exceed with
    the probability of the risk, or if a single block does. Large blocks detect faint motion, whose changes have the
    same sign at neighbouring pixels; single blocks detect objects smaller than a cell. The risk is 0.00001 per cell.
    In little light, it has also moved if a pixel of an ideal sensor cannot differ as much, :math:`|d| > 1 + g q`.

    Args:
        recent: counts (H, W).
        reference: earlier counts (H, W).
        share: ratio of the clocks of the recent counts to those of the reference, a number or (H, W); infinity for
            cells without a reference, which count as moved.
        step: what counts are rounded to, (H, W): 1 for numbers of spikes, less for sums of :func:`spikekit.tfi`.
        soft: the gain always varies, as only then its errors cancel over time, like those of counts.

    Returns:
        The cells (h, w) that have moved; the gain (H, W); and (2, 4, h, w): by how much the sums over blocks of 1,
        2, 4 and 8 pixels exceed K, and K, all 0 without a reference.

    Example:
        >>> at_rest, lamp = torch.full((16, 16), 8.0), torch.full((16, 16), 12.0)
        >>> moved, gain, _ = find_changes(lamp, at_rest, 1.0)
        >>> moved.any().item(), round(gain.mean().item(), 2)
        (False, 1.5)
    """
    share, step = (torch.as_tensor(given, device=recent.device).expand_as(recent) for given in (share, step))
    unknown, each = share[::CELL, ::CELL].isinf(), share.where(share.isfinite(), 0.0)
    expected = each * reference
    spread = _spread(expected, each, step)
    moved, excess = _moved(recent, expected, *spread)
    gain, better = _gain(*(_sum(plane, CELL) for plane in (recent, expected, spread[0])), ~unknown, soft)
    if soft or better.sum() > 25:
        lit = F.interpolate(gain[None, None], scale_factor=CELL, mode="bicubic")[0, 0]
        lit = lit[: recent.shape[0], : recent.shape[1]]
        with_gain = _moved(recent, lit * expected, *_spread(lit * expected, lit * each, step))
        if with_gain[0].sum() <= moved.sum() and (soft or better[~with_gain[0]].sum() > 25):
            return with_gain[0] | unknown, lit, with_gain[1] * ~unknown
    return moved | unknown, torch.ones_like(recent), excess * ~unknown


def _moved(recent: Tensor, expected: Tensor, variance: Tensor, bound: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cells whose light has changed, and the excess of :func:`find_changes`."""
    off = recent - expected
    moved, sums = F.max_pool2d((off.abs() - bound)[None], CELL, ceil_mode=True)[0] > 0, []
    for block in (1, 2, 4, CELL):
        if block > 1:
            off, variance = _sum(off, 2), _sum(variance, 2)
        squares, side = off.square() / variance, CELL // block
        total, blocks = _sum(squares, side), _sum(torch.ones_like(squares), side)
        sums.append(torch.stack([total - blocks, blocks]))
        most = F.max_pool2d(squares[None], side, ceil_mode=True)[0]
        moved |= (total > _limit(blocks)) | (most > _limit(1, side**2))
    return moved, torch.stack(sums, 1)


def _spread(expected: Tensor, each: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Return the variance of the difference of a count from the expected one, and its bound."""
    part = 0.25 - (expected - expected.floor()).sub_(0.5).square_()
    # that of a pixel depends on the rounding of its reference, so cells take their mean, but those with too few spikes
    even, count = F.avg_pool2d(torch.stack([part, expected]), CELL, ceil_mode=True)
    even, few = (_pixels(cells, Box(0, 0, *part.shape)) for cells in (even, count < 0.5))
    part = torch.where(few, part, even).clamp_(min=_LEAST)
    counted = part + each * (5 * each + 3) / 12
    timed = step**2 * (1 + each + each.square()) / 4
    extra = _NOISE * expected * (1 + each)
    are_timed = (step < 1).float()
    return torch.lerp(counted, timed, are_timed) + extra, each + 1.1 + 6 * extra.sqrt() + are_timed / (1 - are_timed)


def _limit(count: Tensor | int, tests: int = 1) -> Tensor | float:
    """Return what the sum of squares of normal numbers exceeds with the probability of the risk."""
    x = math.log(_TESTS * tests / _RISK)
    return count + 2 * (count * x) ** 0.5 + 2 * x


def find_misfits(off: Tensor, before: Tensor, after: Tensor, spike: float) -> Tensor:
    """Find where spikes contradict a picture more than those of two neighbours contradict theirs.

    A cell contradicts if its sum of squares over blocks of 1, 2, 4 or 8 pixels exceeds twice that of its neighbours by
    more than chance, or if the mean difference of a part of 4 x 4 cells or of all is not that of the neighbours, as
    under a lamp. Given are the light (H, W) by the spikes minus that of the picture, the same of the picture before and
    of that after, and the light of a spike.
    """
    planes, found = torch.stack([off, before, after]) / spike, False
    each = _sum(torch.ones_like(off), CELL)
    for block in (1, 2, 4, CELL):
        planes = planes if block == 1 else F.avg_pool2d(planes, 2, ceil_mode=True, divisor_override=1)
        squares = F.avg_pool2d(planes.square(), CELL // block, ceil_mode=True, divisor_override=1)
        blocks = each / block**2
        found = found | (squares[0] > 1.5 * squares[1:].amin(0) + block**2 / 6 * (_limit(blocks) - blocks))
    lamp = planes[0] - planes[1:].mean(0)
    for side in (4, max(lamp.shape)):
        total, pixels = _sum(lamp, side), _sum(each, side)
        lit = total.square() > 3 / 8 * pixels * _limit(1)
        found |= lit.repeat_interleave(side, 0).repeat_interleave(side, 1)[: lamp.shape[0], : lamp.shape[1]]
    return found


def _gain(recent: Tensor, expected: Tensor, variance: Tensor, cells: Tensor, soft: bool) -> tuple[Tensor, Tensor]:
    """Return the gain of every cell, and by how much it reduces the square."""
    gain, found = torch.ones_like(recent), []
    for side in (*_WINDOWS, 1):  # the last step is not used
        lit = gain * expected
        off = recent - lit
        squares = cells * off.square() / variance
        found.append((gain, squares))
        weight = cells / (1 + squares / (4 * squares.mean()).clamp(min=4))  # less for what moves
        parts = weight * torch.stack([lit * off / variance, lit.square() / variance + _SAME])
        if side:
            parts = F.avg_pool2d(F.avg_pool2d(parts, side, 1, side // 2), side, 1, side // 2)
        else:
            parts = parts.mean((1, 2), keepdim=True)
        gain = gain * (1 + parts[0] / parts[1].clamp(min=1e-6)).clamp(0.1, 10)
    (_, before), (_, _), (same, even), *_, (smooth, after) = found
    if soft or (_sum((even - after).clamp(-25, 25), CELL) > _SOFT).any():
        return smooth, (before - after).clamp(-25, 25)
    return same, (before - even).clamp(-25, 25)


def _charge(spikes: Tensor, clock: int, near: int) -> Tensor:
    """Return the charge (H, W) at the beginning of a clock, the past share of the interval between two spikes."""
    empty = 1 - spikes[clock - near : clock + near].to(torch.uint8)
    past, coming = torch.zeros_like(empty[0]), torch.ones_like(empty[0])
    for before, after in zip(empty[:near], empty[near:].flip(0), strict=True):
        past.add_(1).mul_(before)
        coming.mul_(after).add_(1)
    return past / (past + coming).float()


def _sum(plane: Tensor, side: int) -> Tensor:
    """Return sums over blocks; those at the right and bottom edges may be smaller."""
    return F.avg_pool2d(plane[None], side, ceil_mode=True, divisor_override=1)[0]


def _mean(plane: Tensor) -> Tensor:
    """Return means of cells."""
    return F.avg_pool2d(plane[None], CELL, ceil_mode=True)[0]


def grown(cells: Tensor) -> Tensor:
    """Return cells and their neighbours."""
    return F.max_pool2d(cells[None].float(), 3, 1, 1)[0] > 0


def _cells(cells: Tensor, box: Box) -> Tensor:
    """Return the cells of a box that begins with a cell."""
    return Box(box.top // CELL, box.left // CELL, -(-box.bottom // CELL), -(-box.right // CELL)).of(cells)


def _pixels(cells: Tensor, box: Box, scale: int = 1) -> Tensor:
    """Return the value of its cell for every pixel of a box."""
    return box.of(_enlarged(_cells(cells, box), CELL * scale), box[:2], scale)


def _enlarged(plane: Tensor, times: int) -> Tensor:
    """Return every value ``times`` times in both directions."""
    if (plane == plane[0, 0]).all():
        return plane[:1, :1].expand(*(times * side for side in plane.shape))
    return plane.repeat_interleave(times, 0).repeat_interleave(times, 1)


def blend(cells: Tensor, box: Box, scale: int) -> Tensor:
    """Return weights of a box's picture: 1 in cells and up to a quarter of a cell around, 0 from three quarters on."""
    halves = grown(_cells(cells, box).repeat_interleave(2, 0).repeat_interleave(2, 1))
    weight = F.interpolate(halves[None, None].float(), scale_factor=CELL // 2 * scale, mode="bilinear")[0, 0]
    return box.of(weight, box[:2], scale)


class Rest:
    r"""Make the pictures of consecutive key frames, with the network running only where something moves.

    Convention:
        What the pixels integrated in the middle of a clip, of the length of a key frame distance, is compared with what
        they did before: alone, which detects sudden motion, and together with its predecessors, up to the length of the
        reference, which detects drift. The reference grows while nothing moves, and starts anew where something does.
        It is the sum of :func:`spikekit.tfi` where intervals are short enough, and the number of spikes elsewhere. Sums
        of squares over 3 x 3 cells detect faint drift, and with those of about 25 key frames what turns or sways with
        little contrast. Until all cells rest, the halves of the middle are also compared, as an object that turns in
        step with the key frames gives them equal sums.

        A cell is still if nothing changed during its clip, and rests if nothing changed in the 160 clocks before it
        either, as a single test may miss slow motion. If half of the 9 x 9 cells around or a sixth of all do not rest,
        these are 640 clocks, as what has little contrast probably moves with them; also if a cell rested until a sum of
        key frames showed its drift. A resting cell shows the mean of the network's first eight pictures of the still
        cell; after these the network does not run. Neighbours of cells that do not rest are computed and blended; in
        the dark, where motion is seen late, they do not rest either. The light of a lamp at the clock of the picture is
        removed from the mean, and applied to the picture; if it has changed by more than a factor of 8, the cell has.
        When 75 % of the cells have changed, or have a neighbour that did, the next eight pictures are not tested.

        The mean over all clocks of an ideal sensor converges to the exact light. At the resolution of the sensor, the
        picture is corrected towards it, by the share of their difference that is not noise of the mean, but not at
        single pixels that differ by more than five times the root mean square of their cell, which may be defective. It
        is corrected again when the cell has a quarter more clocks. Of a calibrated sensor, changes are found in the
        spikes that it fired; the mean is corrected by the calibration.

    Args:
        scale: pixels of the picture per sensor pixel.
        pattern: Bayer phase of the sensor, or grey.
        white: white level of the network in spikes per clock.
        noise_level: that of an unknown sensor, 1 for the one used in training; its mean is not used above 0.

    Attributes:
        moving: cells (h, w) of the last picture that do not rest, and their neighbours.
        computed: cells (h, w) of the last picture that the network computed.
    """

    #: earlier pictures that a part of a film begins with, so that what rests is found again
    warm_up = _PICTURES + 3

    def __init__(self, scale: int, pattern: str, white: float, noise_level: float = 0.0) -> None:
        self.scale, self.pattern, self.white, self.noise_level = scale, pattern, white, noise_level
        self._clock, self._untested = -math.inf, 0

    def _start(self, spikes: Tensor) -> None:
        self._earlier, self._later, self._seen = spikes.new_zeros(3, *spikes.shape[-2:], dtype=torch.float32)
        self._timed = self._seen == 0
        # clocks of both counts, scaled to the first light; clocks without a change; pictures in the mean; clocks drawn
        self._before, self._since = self._seen.repeat(2, 1, 1)
        self._calm, self._count, self._drawn = _sum(self._seen, CELL).repeat(3, 1, 1)
        self._excess = self._calm.repeat(2, 4, 1, 1)
        self._light = self._lit = torch.ones_like(self._seen)
        self._mean: Tensor | None = None
        self._soft = False

    def __call__(
        self, spikes: Tensor, clock: int, make: Callable[..., Tensor], exposure: float, known: Calibration | None
    ) -> Tensor:
        """Return a picture.

        Args:
            spikes: clip (N, H, W), as the sensor fired it.
            clock: clock of the picture, larger than that of the previous one.
            make: function that returns the network's picture (3, s h, s w) of a box; its second argument tells that
                nothing moves there.
            exposure: factor of the network's pictures.
            known: calibration of the sensor; None for an ideal or an unknown one.
        """
        frames, whole, scale = len(spikes), Box(0, 0, *spikes.shape[-2:]), self.scale
        if self._untested:
            self._untested -= 1
            self._clock = -math.inf
            self.moving = self.computed = torch.ones_like(self.computed)
            return make(whole, False)
        came = int(min(clock - self._clock, frames + 1))
        if came > frames or self._earlier.shape != spikes.shape[-2:]:
            self._start(spikes)
        else:
            self._compare(spikes, came, known)
        self._clock = clock
        still = self._calm >= frames - 1
        unsure = self._calm < frames - 1 + _SURE
        around = F.avg_pool2d(unsure[None].float(), 9, 1, 4, count_include_pad=False)[0]
        unsure |= (around.clamp(min=3 * unsure.float().mean()) > 0.5) & (self._calm < frames - 1 + _SURER)
        dark = _sum(self._earlier + self._later - _DARK * (self._before + self._since), CELL) < 0
        unsure |= grown(unsure & dark) & dark
        self.moving = near = grown(unsure)
        new = still & (self._count < _PICTURES)
        self.computed = near | new
        self._count = (self._count + new) * still
        self._drawn *= still
        if not still.any():
            self._mean = None
            return make(whole, False)
        boxes = boxes_around(self.computed, near, whole) if self.computed.any() else []
        parts = [(box, make(box, static).float()) for box, static in boxes]
        if self._mean is None:
            self._mean, self._shown = torch.zeros_like(parts[0][1]).repeat(2, 1, 1, 1)  # the first pictures are whole
        for box, part in parts:
            weight = _pixels(new / self._count.clamp(min=1), box, scale)
            if weight.any():
                mean = box.of(self._mean, scale=scale)
                mean.lerp_(part / _enlarged(box.of(self._lit), scale), weight)
                box.of(self._seen).copy_(bin_to_sensor(mean, self.pattern, scale=scale))
        if boxes[:1] == [(whole, False)]:  # blending the few cells at rest would cost more than it gains
            return parts[0][1]
        clocks = _mean(self._before + self._since)
        due = ~unsure & (new | (clocks > _MORE * self._drawn))
        if due.any() and not self.noise_level:
            self._draw(due, exposure, known)
        shown = (self._mean if self.noise_level else self._shown) * _enlarged(self._lit, scale)
        for box, part in parts:
            box.of(shown, scale=scale).lerp_(part, blend(unsure, box, scale))
        return shown.clamp_(0, 1)

    def _compare(self, spikes: Tensor, clocks: int, known: Calibration | None) -> None:
        """Add the middle of a clip to the counts, which start anew where the scene has changed."""
        whole, frames = Box(0, 0, *spikes.shape[1:]), len(spikes)
        near = (frames - clocks) // 2
        middle = slice(frames // 2 - clocks // 2, frames // 2 - clocks // 2 + clocks)
        recent = spikes[middle].sum(0, dtype=torch.float32)
        timed = recent + (_charge(spikes, middle.stop, near) - _charge(spikes, middle.start, near) if near else 0)
        # where intervals are shorter than near; of even light all pixels, as a choice by chance favours some charges
        around = F.avg_pool2d(timed[None], 5, 1, 2, count_include_pad=False)[0]
        self._timed &= (near * timed >= 1.2 * clocks) & ((near * around >= 1.5 * clocks) | (self._earlier > 0))
        recent = torch.where(self._timed, timed, recent)
        if known is not None:
            recent *= (known.defects == 0).to(recent.device)
        step = torch.where(self._timed, recent / clocks, 1)
        share = clocks * self._light / self._before
        sudden, gain, excess = find_changes(recent, self._earlier, share, step, self._soft)
        self._light *= gain
        self._soft |= bool(gain.amax() > 1.001 * gain.amin())
        self._later += recent
        self._since += clocks * self._light
        share = self._since / self._before
        slow, slow_gain, slow_excess = find_changes(self._later, self._earlier, share, step, self._soft)
        self._since *= slow_gain
        changed = sudden | slow | (_mean(self._light).log2().abs() > _DEEP)
        changed &= self._before[::CELL, ::CELL] > 0
        if (self._count < _PICTURES).any():
            first, second = spikes[middle][clocks % 2 :].unflatten(0, (2, -1)).sum(1, dtype=torch.float32)
            changed |= find_changes(second, first, 1.0, soft=self._soft)[0]
        if grown(changed).float().mean() > _BUSY:
            self._untested = _UNTESTED
        late = slow & ~sudden & ((self._calm < 0) | (self._calm > _SURE))
        self._calm = torch.where(changed, late * float(_SURE - _SURER), self._calm + clocks)
        gone = _pixels(changed, whole)
        for plane in (self._earlier, self._later, self._before, self._since):
            plane.masked_fill_(gone, 0)
        self._timed |= gone
        self._light.masked_fill_(gone, 1)
        self._lit = self._light_at(spikes, middle, known)
        fade = self._light.new_tensor([_FADE, _FADE**2])[:, None, None, None]
        self._excess = (fade * self._excess + excess) * ~changed
        alike = self._light.new_tensor(_ALIKE)[:, None, None]
        for one, times in ((self._excess, alike), (slow_excess * ~changed, 1)):
            total, tests = F.avg_pool2d(one, 3, 1, 1, divisor_override=1) / times
            self._calm[(total + tests > _limit(tests)).any(0)] = 0
        full = _pixels(_sum(self._since - self._before, CELL) >= 0, whole)
        for one, more in ((self._earlier, self._later), (self._before, self._since)):
            one += more * full
            more *= ~full

    def _light_at(self, spikes: Tensor, middle: slice, known: Calibration | None) -> Tensor:
        """Return the light of lamps at the clock of the picture, relative to the first."""
        under = (self._light != 1) & (self._before > 0)
        if not under.any():
            return self._light
        quarter = len(spikes) // 4
        parts = (spikes, spikes[quarter:-quarter], spikes[middle])
        total, half, mean = (part.mean(0, dtype=torch.float32)[under].sum() for part in parts)
        # dark current does not follow the light
        rate = (self._earlier / self._before)[under]
        dark = _LEAK * self.noise_level if known is None else known.dark.mean().item()
        share = dark / (rate.square().sum() / rate.sum()).clamp(min=2 * dark)
        # the mean of a parabola over a clip differs from its middle four times as much as that over half of it
        lit = ((4 * half - total) / (3 * mean) * self._light - share) / (1 - share)
        return lit.nan_to_num(1).clamp(min=0.01).where(under, 1.0)

    def _draw(self, due: Tensor, exposure: float, known: Calibration | None) -> None:
        """Correct the mean of pictures towards that of all spikes, in boxes around some cells."""
        clocks = self._before + self._since
        self._drawn = _mean(clocks).where(due, self._drawn)
        each, whole, scale = (1 / clocks).nan_to_num(posinf=0), Box(0, 0, *self._seen.shape), self.scale
        rate = (self._earlier + self._later) * each
        if known is not None:
            rate = known.correct(rate, self.pattern)
        white = exposure / self.white
        for box, _ in boxes_around(due, due, whole):
            near = box.grown(CELL, whole)
            off = white * near.of(rate) - near.of(self._seen)
            inside, power = Box(0, 0, *off.shape), _mean(off.square())
            trust = 1 - (white * _mean(near.of(each))).square() / 6 / power
            trust = trust.nan_to_num(0).clamp(min=0) * (_cells(self._count, near) > 0)
            off = off * (off.square() < 25 * _pixels(power, inside)) * _pixels(trust, inside)
            colors = demosaic(off, self.pattern)
            # antialias does not change the result of enlarging, but is three times faster
            part = F.interpolate(colors[None], scale_factor=scale, mode="bilinear", antialias=True)
            mean, shown = (box.of(planes, scale=scale) for planes in (self._mean, self._shown))
            torch.add(mean, box.of(part[0], near[:2], scale), out=shown)


def boxes_around(computed: Tensor, near: Tensor, whole: Box) -> list[tuple[Box, bool]]:
    """Return boxes around computed cells, and whether nothing moves there; where boxes overlap, the last counts."""
    from scipy.ndimage import find_objects, label

    found, area = [], 0
    groups = label(grown(computed).cpu().numpy())[0] * computed.cpu().numpy()
    for rows, columns in find_objects(groups):
        box = Box(*(CELL * end for end in (rows.start, columns.start, rows.stop, columns.stop)))
        found.append((box.grown(0, whole), not near[rows, columns].any().item()))
        top, left, bottom, right = box.grown(AROUND, whole)
        area += (bottom - top) * (right - left)
    if found and area >= 1.2 * whole.bottom * whole.right:
        return [(whole, not near.any().item())]
    return sorted(found, key=lambda one: not one[1])
