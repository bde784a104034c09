"""Gains of a sensor's pixels, estimated from a moving scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.calibration.calibration import Calibration
from spikekit.calibration.measure import Measured
from spikekit.color.cfa import GREY, bayer_mask
from spikekit.color.demosaic import demosaic
from spikekit.filters import separable_filter
from spikekit.flow.fields import ends_inside
from spikekit.flow.tvl1 import tvl1_flow
from spikekit.progress import progress
from spikekit.sensor.noise import WORKS
from spikekit.warp.warp import flow_warp

MOST_SEGMENTS = 100  #: upper limit, which bounds memory
LEAST_SEGMENTS = 12  #: lower limit; fewer hardly contain motion
_SHORTEST, _LONGEST = 20, 200  # frames per segment
_SPIKES = 2  # target for the spikes of a pixel per segment

_LEAST_SIDE = 3  # smallest side of a sensor, in pixels, on which motion can be estimated
_FAR = 8.0  # largest displacement between compared segments, in pixels
_SOURCES = 16  # segments on each side that one is compared with
_PATH = 4.0  # smallest displacement over the recording, in pixels, that separates gain from texture
_SHARE = 0.25  # smallest share of pixels with enough displacement
_AGREE = 0.4  # smallest correlation between the halves of a recording
_LEAST_COUNT = 3  # smallest number of comparisons of a pixel in each half
_AROUND = 15  # side of a neighbourhood, in pixels
_LEAST_GAIN = 0.1  # pixels below this are dead
_ROUNDS = 2
_ATTACHMENT = 120.0  # data weight of TV-L1 for pictures in spikes per frame
_GREY = 0.25, 0.5, 0.25  # mean over the Bayer cells that contain a pixel


class Segments(NamedTuple):
    """Spike counts of every pixel in consecutive segments of a recording."""

    counts: Tensor  # (J, H, W), uint8
    frames: int  # per segment


def segment_length(rate: float) -> int:
    """Return the number of frames per segment for a mean rate in spikes per frame."""
    return min(max(_SHORTEST, math.ceil(_SPIKES / max(rate, 1e-9))), _LONGEST)


def count_segments(chunks: Iterable[Tensor], frames: int) -> Segments:
    """Count the spikes of chunks (T_i, H, W) in segments of 1 to 255 frames; an incomplete last one is dropped.

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
    r"""Measure gains in a recording of a moving scene.

    .. math:: e_h = \overline{r - \hat I}_h \approx (g - 1) \, \overline{\hat I}_h, \quad h = 1, 2, \qquad
        \sigma_g^2 = \frac{\mathrm{E}\, e_1 e_2}{\mathrm{E}\, \overline{\hat I}_1 \overline{\hat I}_2}

    Convention:
        The expected rate of a pixel is the mean over other pixels that saw the same point: the rates of up to 16
        segments on either side, demosaiced and warped along motion of at most 8 pixels. The mean excess of a pixel over
        that rate is computed for each half of the recording. An excess common to both halves is due to the gain; one
        that differs is due to texture. The covariance of the halves therefore gives the variance of the gains, and
        their difference the error, as a function of brightness and in a neighbourhood. The gain is the maximum a
        posteriori estimate. Motion is TV-L1 flow between segments, accumulated. A second round repeats all this with
        corrected pixels.

        A gain stays 1 if the scene has moved by less than 4 pixels at that pixel. Dark rates cannot be separated from
        gains: a pixel with a high dark rate in a dim scene gets a larger gain.

        ``known`` holds the dead and hot pixels. The result is ``None`` if fewer than a quarter of the pixels have seen
        enough motion, or if the halves correlate by less than 0.4, as for an ideal sensor.

    Reference:
        Registration-based non-uniformity correction: Hardie, Hayat, Armstrong and Yasuda, Scene-based nonuniformity
        correction with video sequences and registration, Applied Optics 39(8), 2000.
    """
    counts, works = segments.counts, known.defects == WORKS
    if min(known.size) < _LEAST_SIDE:
        return None
    planes = bayer_mask(*known.size, pattern or GREY, dtype=torch.bool) & works
    measured = Measured(known)
    for _ in range(_ROUNDS):
        # sums over both halves: number of comparisons, expected light, and excess of the rate over it
        halves = torch.zeros(3, 2, *known.size, dtype=torch.float64)
        for number, (light, seen) in enumerate(_expected(segments, measured.calibration, pattern)):
            excess = counts[number] / segments.frames - light
            part = torch.stack([torch.ones_like(light), light, excess]) * (seen & works)
            halves[:, 2 * number // len(counts)] += part
        found = _most_likely(halves, works, planes, known)
        if found is None:
            return None
        measured = found
    return measured


def _expected(segments: Segments, known: Calibration, pattern: str | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the expected rate of every segment, (H, W), from other pixels, and where it is known."""
    count, size = len(segments.counts), known.size

    def light(number: int) -> Tensor:
        return known.correct(segments.counts[number] / segments.frames, pattern)

    def picture(number: int) -> Tensor:
        return light(number)[None] if pattern is None else demosaic(light(number), pattern)

    place = _places(light, count, pattern is not None)
    passed = torch.stack([part.mean(0) for part in place.tensor_split(4)])
    enough = (passed.amax(0) - passed.amin(0)).norm(dim=0) * 4 / 3 >= _PATH
    mask = None if pattern is None else bayer_mask(*size, pattern)
    pictures: dict[int, Tensor] = {}
    for number in progress(range(count), "gains"):
        rate, (total, sources) = segments.counts[number] / segments.frames, torch.zeros(2, *size)
        near = range(max(number - _SOURCES, 0), min(number + _SOURCES + 1, count))
        pictures = {n: pictures[n] if n in pictures else picture(n) for n in near}
        for n in near:
            flow = place[n] - place[number]
            use = enough & (flow.norm(dim=0) <= _FAR) & ends_inside(flow)
            if use.any():
                seen = flow_warp(pictures[n], flow)
                seen = use * (seen[0] if mask is None else (seen * mask).sum(0))
                lamp = (rate * use).sum() / seen.sum().clamp(min=1e-9)  # the illumination may change
                total += lamp * seen
                sources += use
        yield (total / sources.clamp(min=1)).clamp(min=0), sources > 0


def _places(light: Callable[[int], Tensor], count: int, color: bool) -> Tensor:
    """Return the displacement of the scene at each pixel since the first segment, (J, 2, H, W), in pixels."""

    def grey(number: int) -> Tensor:
        plane = light(number)
        return separable_filter(plane[None, None], _GREY)[0, 0] if color else plane

    place, before = torch.zeros(count, 2, *light(0).shape), 0
    for number in progress(range(count), "motion"):
        start, end = max(number - 1, 0), min(number + 1, count - 1)
        ends = torch.stack([grey(start), grey(end)])
        ends[1] *= ends[0].mean() / ends[1].mean().clamp(min=1e-9)
        times = torch.tensor([[start - number, end - number]]) / (end - start)
        velocity = tvl1_flow(ends[None], times, torch.full_like(ends[:1], _ATTACHMENT))[0] / (end - start)
        if number:
            place[number] = place[number - 1] + (before + velocity) / 2
        before = velocity
    return place


def _most_likely(halves: Tensor, works: Tensor, planes: Tensor, known: Calibration) -> Measured | None:
    """Return the most likely gains, given the sums over both halves of a recording."""
    from scipy.optimize import nnls

    count = halves[0]
    used = works & (count >= _LEAST_COUNT).all(0)
    if used.sum() < _SHARE * works.sum():
        return None
    light, excess = (part[:, used] / count[:, used] for part in halves[1:])
    common = excess.prod(0).mean()
    if not common > _AGREE * excess.square().mean():  # also false if nothing fires
        return None
    spread = common / light.prod(0).mean()
    # the relative error of dark pixels is larger
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
    """Return the mean, (H, W), over the pixels of a window where ``where`` is True."""
    total, count = (
        F.avg_pool2d(plane[None, None], _AROUND, 1, _AROUND // 2)[0, 0] for plane in (values * where, where.to(values))
    )
    return total / count.clamp(min=1e-9)
