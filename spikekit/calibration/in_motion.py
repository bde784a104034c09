"""Gains of the pixels of a sensor from any scene that moves across it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from kornia.filters import filter2d_separable
from torch import Tensor

from spikekit.calibration.calibration import Calibration, colors
from spikekit.calibration.measure import Measured
from spikekit.color.cfa import bayer_mask
from spikekit.color.demosaic import demosaic
from spikekit.flow.tvl1 import tvl1_flow
from spikekit.progress import progress
from spikekit.sensor.noise import WORKS
from spikekit.warp.warp import flow_warp

MOST_SEGMENTS = 100  #: of a recording are enough, and what memory is for
LEAST_SEGMENTS = 12  #: in fewer, hardly anything has moved
_SHORTEST, _LONGEST = 20, 200  # frames of a segment
_SPIKES = 2  # that a pixel fires in a segment, at least, as far as the longest allows

_LEAST_SIDE = 3  # pixels, of a sensor that something can be seen to move across
_FAR = 8.0  # pixels; what has moved further may look different
_SOURCES = 16  # segments before and after one, that say what it should see
_PATH = 4.0  # pixels of a scene that a pixel has to see before gain is told from texture
_SHARE = 0.25  # of the pixels, at least, that have seen that much
_AGREE = 0.4  # correlation of both halves of a recording, below which they do not say the same
_LEAST_COUNT = 3  # segments of a half that say something about a pixel
_AROUND = 15  # side of the window of a pixel's neighbours, in pixels
_LEAST_GAIN = 0.1  # less is a dead pixel
_ROUNDS = 2
_ATTACHMENT = 120.0  # of the flow to pictures in firing rates
_GREY = torch.tensor([[0.25, 0.5, 0.25]])  # each pixel the mean of the Bayer cells that it is part of


class Segments(NamedTuple):
    """Counts of the spikes of every pixel in segments of a recording that follow each other without a gap."""

    counts: Tensor  # (J, H, W), uint8
    frames: int  # of each


def segment_length(rate: float) -> int:
    """Return how many frames a segment has where pixels fire so often in a frame."""
    return min(max(_SHORTEST, math.ceil(_SPIKES / max(rate, 1e-9))), _LONGEST)


def count_segments(chunks: Iterable[Tensor], frames: int) -> Segments:
    """Count spikes of chunks (T_i, H, W) in segments of 1 to 255 frames; what is left over does not count.

    Example:
        >>> count_segments([torch.ones(30, 1, 1), torch.zeros(15, 1, 1)], 20).counts.flatten().tolist()
        [20, 10]
    """
    counts, left = [], None
    for chunk in chunks:
        left = chunk if left is None else torch.cat([left, chunk])
        *whole, left = left.tensor_split(tuple(range(frames, len(left) + 1, frames)))
        counts += [(segment != 0).sum(0).byte() for segment in whole]
    return Segments(torch.stack(counts), frames)


def calibrate_in_motion(segments: Segments, known: Calibration, pattern: str | None = None) -> Measured | None:
    r"""Measure gains in a recording of any scene that moves.

    .. math:: e_h = \overline{r - \hat I}_h \approx (g - 1) \, \overline{\hat I}_h, \quad h = 1, 2, \qquad
        \sigma_g^2 = \frac{\mathrm{E}\, e_1 e_2}{\mathrm{E}\, \overline{\hat I}_1 \overline{\hat I}_2}

    Convention:
        Where the scene moves, a pixel is told what it should see by pixels that saw the same before and after: the
        rates of up to 16 segments on either side, demosaiced and moved along the motion, as far as that is 8 pixels at
        most. What a pixel fires more or less than that, on average over half a recording, is its gain if it shows in
        both halves, and the scene's texture if it shows in one. So what both halves have in common says how far gains
        are apart, and what they differ by, how exact they are, for pixels of a brightness and for those of a
        neighbourhood; a pixel gets the most likely gain, given both. Motion is that of TV-L1 between segments, added
        up. All of it is done twice, the second time with the pixels corrected.

        Gains stay 1 where less than 4 pixels of the scene have passed a pixel, and everywhere if that is so for three
        quarters of the pixels or if the halves correlate by less than 0.4. Dark rates are not told from gains: a pixel
        of much leak in little light is given a larger gain.

        ``known`` are the dead and hot pixels. ``None`` where too little moves or the halves of the recording do not
        agree, as those of an ideal sensor do not.

    Reference:
        Registration-based non-uniformity correction: Hardie, Hayat, Armstrong and Yasuda, Scene-based nonuniformity
        correction with video sequences and registration, Applied Optics 39(8), 2000.
    """
    counts, works = segments.counts, known.defects == WORKS
    if min(known.size) < _LEAST_SIDE:
        return None
    planes = [torch.from_numpy(plane) & works for plane in colors(known.size, pattern)]
    measured = Measured(known)
    with progress(what="motion and gains", total=2 * _ROUNDS * len(counts)) as bar:
        for _ in range(_ROUNDS):
            # over both halves: how often each pixel was seen, its light, and by how much more often it fires
            halves = torch.zeros(3, 2, *known.size, dtype=torch.float64)
            for number, (light, seen) in enumerate(_expected(segments, measured.calibration, pattern, bar.update)):
                excess = counts[number] / segments.frames - light
                halves[:, 2 * number // len(counts)] += torch.stack([torch.ones_like(light), light, excess]) * (
                    seen & works
                )
            found = _most_likely(halves, works, planes, known)
            if found is None:
                return None
            measured = found
    return measured


def _expected(
    segments: Segments, known: Calibration, pattern: str | None, done: Callable[[], object]
) -> Iterator[tuple[Tensor, Tensor]]:
    """What every segment should see, (H, W), as other pixels saw it, and where anyone did."""
    count, size = len(segments.counts), known.size

    def light(number: int) -> Tensor:
        return known.correct(segments.counts[number] / segments.frames, pattern)

    place = _places(light, count, pattern is not None, done)
    passed = torch.stack([part.mean(0) for part in place.tensor_split(4)])
    enough = (passed.amax(0) - passed.amin(0)).norm(dim=0) * 4 / 3 >= _PATH
    mask = None if pattern is None else bayer_mask(*size, pattern)
    pictures: dict[int, Tensor] = {}
    for number in range(count):
        rate, (total, sources) = segments.counts[number] / segments.frames, torch.zeros(2, *size)
        near = range(max(number - _SOURCES, 0), min(number + _SOURCES + 1, count))
        pictures = {n: pictures[n] if n in pictures else _colored(light(n), pattern) for n in near}
        for n in near:
            flow = place[n] - place[number]
            use = enough & (flow.norm(dim=0) <= _FAR) & _inside(flow)
            if use.any():
                seen = flow_warp(pictures[n], flow)
                seen = use * (seen[0] if mask is None else (seen * mask).sum(0))
                lamp = (rate * use).sum() / seen.sum().clamp(min=1e-9)  # the light of the whole scene may change
                total += lamp * seen
                sources += use
        yield (total / sources.clamp(min=1)).clamp(min=0), sources > 0
        done()


def _places(light: Callable[[int], Tensor], count: int, color: bool, done: Callable[[], object]) -> Tensor:
    """How far what each pixel sees has moved since the first segment, (J, 2, H, W), in pixels."""

    def grey(number: int) -> Tensor:
        plane = light(number)
        return filter2d_separable(plane[None, None], _GREY, _GREY, "reflect")[0, 0] if color else plane

    place, before = torch.zeros(count, 2, *light(0).shape), 0
    for number in range(count):
        start, end = max(number - 1, 0), min(number + 1, count - 1)
        ends = torch.stack([grey(start), grey(end)])
        ends[1] *= ends[0].mean() / ends[1].mean().clamp(min=1e-9)
        times = torch.tensor([[start - number, end - number]]) / (end - start)
        velocity = tvl1_flow(ends[None], times, torch.full_like(ends[:1], _ATTACHMENT))[0] / (end - start)
        if number:
            place[number] = place[number - 1] + (before + velocity) / 2
        before = velocity
        done()
    return place


def _colored(light: Tensor, pattern: str | None) -> Tensor:
    return light[None] if pattern is None else demosaic(light, pattern)


def _inside(flow: Tensor) -> Tensor:
    height, width = flow.shape[-2:]
    x, y = flow[0] + torch.arange(width), flow[1] + torch.arange(height)[:, None]
    return (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)


def _most_likely(halves: Tensor, works: Tensor, planes: list[Tensor], known: Calibration) -> Measured | None:
    """Gains, given what both halves of a recording say."""
    from scipy.optimize import nnls

    count = halves[0]
    used = works & (count >= _LEAST_COUNT).all(0)
    if used.sum() < _SHARE * works.sum():
        return None
    light, excess = (part[:, used] / count[:, used] for part in halves[1:])
    common = excess.prod(0).mean()
    if not common > _AGREE * excess.square().mean():  # nor where nothing fires
        return None
    spread = common / light.prod(0).mean()
    # dark pixels are less exact, relative to their light
    terms = torch.stack([light.square().mean(0), torch.ones_like(light[0])], dim=1)
    weight = 1 / (terms[:, :1] + terms[:, 0].mean())
    differ = torch.zeros_like(count[0])
    differ[used] = excess.diff(dim=0)[0].square() / 2
    shape, floor = nnls((terms * weight).numpy(), (differ[used] * weight[:, 0]).numpy())[0]
    error = (shape * light.square() + floor).maximum(_mean_around(differ, used)[used])
    certain = (light.square() / error.clamp(min=1e-12)).sum(0) + 1 / spread
    gain = torch.zeros_like(differ)
    gain[used] = (light * excess / error.clamp(min=1e-12)).sum(0) / certain
    gain = (1 + gain).clamp(min=_LEAST_GAIN).float()
    for plane in planes:
        gain[plane] /= gain[plane].mean()
    return Measured(Calibration(gain, known.dark, known.defects), certain.reciprocal().mean().sqrt().item())


def _mean_around(values: Tensor, where: Tensor) -> Tensor:
    """Means (H, W) over the pixels of a window that count."""
    total, count = (
        F.avg_pool2d(plane[None, None], _AROUND, 1, _AROUND // 2)[0, 0] for plane in (values * where, where.to(values))
    )
    return total / count.clamp(min=1e-9)
