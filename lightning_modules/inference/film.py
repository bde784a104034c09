"""Films: pictures from a stream of spikes, as it arrives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from io import BytesIO
from itertools import chain, count, islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.inference.clips import clip_in_light, clips_around, film_groups, join_frames
from lightning_modules.inference.predict import check_views, predict
from lightning_modules.inference.rest import AROUND, CELL, SEEN, Rest, blend, boxes_around, find_misfits, grown
from lightning_modules.inference.tiles import TILE, TILE_ON_GPU, Box, reach, tiled
from lightning_modules.networks import Network, RecurrentCSCSR
from lightning_modules.networks.recurrent_cscsr import read_forward, read_from_end
from spikekit import Calibration, bin_to_sensor, correct_spikes, flow_warp, linear_motion, upsample_flow
from spikekit.check import check_planes, check_positive, check_whole
from spikekit.io.whole_file import write_whole
from spikekit.recording import white_rate

#: distance of two pictures of the network, in clocks, between which all pictures are made together
_TOGETHER = 12
#: largest motion between two pictures of the network, in sensor pixels, for single clips and with a state
_SLOW = 2.0, 0.75
#: largest share of cells that are computed in an interpolated picture
_MOST = 0.5


class FilmFrame(NamedTuple):
    """A picture of a film.

    Args:
        clock: index of the spike frame that it shows, from the beginning of the stream.
        rgb: (3, s H, s W), [0, 1].
    """

    clock: int
    rgb: Tensor


def film(
    network: Network,
    chunks: Iterable[Tensor],
    every: int = 20,
    *,
    future: int = 0,
    white: float | None = None,
    **how: Any,
) -> Iterator[FilmFrame]:
    r"""Yield the pictures of a stream as it arrives, from a recording or a live camera.

    Convention:
        The picture of clock n needs the clocks n - N // 2 to n + (N - 1) // 2, for a network with clips of N frames. It
        is made as soon as the last of them has arrived, (N - 1) // 2 clocks later: 20 clocks for N = 41, a millisecond
        at 20 kHz. Chunks of c clocks add up to c - 1 clocks, and the network its computing time. The first picture
        shows clock N // 2. Only N frames and the current chunk are kept in memory. In dim light, N is larger, see
        :meth:`lightning_modules.inference.clips.RecordingClips.in_light`; ``noise_level`` is that of joined frames.

        With ``future`` or ``psnr_tolerance``, pictures come in groups, see :class:`FilmMaker`. A picture is then
        delayed by up to ``future`` pictures, or 11 clocks or a picture, and the group is kept in memory.

        The white level is the same in all pictures: ``white``, else the level that 99.9 % of the pixels of the first
        clip do not exceed.

    Args:
        network: network of :mod:`lightning_modules.networks`, on the device of the chunks.
        chunks: spikes (T, H, W) of any length, as :func:`spikekit.iter_spikes` returns with a ``chunk``; they begin
            with the network's Bayer phase.
        every: clocks between two pictures.
        future: later key frames that a picture may wait for, see :class:`FilmMaker`.
        white: white level in spikes per clock.
        how: ``static``, and further arguments of :class:`FilmMaker`.

    Returns:
        An iterator over pictures.

    Raises:
        TypeError: ``white`` is not a number; when iterated, a chunk is not a tensor of real numbers.
        ValueError: an argument is out of range; when iterated, a chunk has another shape.

    Example:
        >>> import torch
        >>> from lightning_modules.networks import ClassicalDecoder
        >>> stream = (torch.rand(30, 8, 10) < 0.3 for _ in range(3))
        >>> [(clock, rgb.shape) for clock, rgb in film(ClassicalDecoder(scale=2), stream)]
        [(20, torch.Size([3, 16, 20])), (40, torch.Size([3, 16, 20])), (60, torch.Size([3, 16, 20]))]
    """
    check_whole("every", every)
    if white is not None:
        check_positive("white", white)
    static = how.pop("static", False)
    maker = FilmMaker(network, future, **how)
    return _pictures(maker, _frames(chunks), every, white, static)


def _pictures(
    maker: FilmMaker, frames: Iterator[Tensor], every: int, white: float | None, static: bool
) -> Iterator[FilmFrame]:
    network = maker.network
    if white is None:
        white, frames = _white_of_first_clip(network, frames)
    length, joined = clip_in_light(network.frames, white, join=network.joins)
    exposure = network.settings["alpha"] / (joined * white)
    clips = clips_around(count(length // 2, every), length, frames)
    joint = ((clock, join_frames(clip, joined)) for clock, clip in clips)
    for group in film_groups(joint, maker.future + 1, maker.together(every / joined)):
        clocks, spikes = [clock for clock, _ in group], torch.stack([clip for _, clip in group])
        pictures = maker(spikes, [clock / joined for clock in clocks], static, exposure)
        for clock, rgb in zip(clocks, pictures, strict=True):
            yield FilmFrame(clock, rgb.clone() if len(group) > 1 else rgb)  # a kept picture does not keep the group


def _white_of_first_clip(network: Network, frames: Iterator[Tensor]) -> tuple[float, Iterator[Tensor]]:
    """Return the white level of the first clip, which is longer in dim light, and the frames from the first on."""
    first: list[Tensor] = []
    white = 1.0
    for _ in range(2):
        first += islice(frames, clip_in_light(network.frames, white, join=network.joins)[0] - len(first))
        white = white_rate(torch.stack(first).float().mean(0).cpu(), network.pattern) if first else white
    return white, chain(iter(first), frames)  # unlike a list, a finished iterator does not keep the frames


def _frames(chunks: Iterable[Tensor]) -> Iterator[Tensor]:
    for chunk in chunks:
        check_planes("chunks", chunk, 3, "(T, H, W)")
        if chunk.ndim != 3:
            raise ValueError(f"chunks: expected (T, H, W), got {tuple(chunk.shape)}")
        yield from chunk


class _Made(NamedTuple):
    """A picture of the network, the motion of its clip, and the light (H, W) in the middle of the clip."""

    clock: int
    rgb: Tensor
    flow: Tensor | None
    light: Tensor


class _Known(NamedTuple):
    """The state of a :class:`RecurrentCSCSR` at a key frame."""

    clock: int
    state: Tensor


class _Group:
    """Clips whose pictures are made together, and one made before its turn, with the network's state after it."""

    def __init__(
        self, clocks: Sequence[int], clips: Sequence[Tensor], exposures: Sequence[float], alpha: float
    ) -> None:
        self.clocks, self.clips, self.exposures, self._alpha = clocks, clips, exposures, alpha
        self.corrected: Callable[[int], Tensor]  # a clip as the network takes it
        self.ahead: tuple[int, _Made, _Known | None] | None = None

    def light(self, n: int) -> tuple[Tensor, float]:
        """Return the light (H, W) in the middle of a clip, and that of a spike."""
        frames = self.clips[n].shape[1]
        middle = self.corrected(n)[0, frames // 4 : frames - frames // 4]
        spike = self.exposures[n] / (self._alpha * len(middle))
        return spike * middle.sum(0, dtype=torch.float32), spike


class FilmMaker:
    r"""Make the pictures of a film, group by group.

    A :class:`lightning_modules.networks.RecurrentCSCSR` passes the state of a key frame to the next. With ``future``,
    groups have ``future + 1`` key frames, which take a backward pass before the forward pass, so that all but the last
    also use the next key frame. Neighbours further away than the length of a clip are not used, as their motion is
    unknown; groups from any other place of a film are therefore allowed.

    With a tolerance, groups have two or more pictures at x2 to x4, see :meth:`together`. If most of the picture moves
    by less than 2 sensor pixels, or 0.75 for a network with a state, from the last whole picture of the network, of the
    clock l, to a later one of the group, of the clock r, those between are interpolated:

    .. math:: I_n(x) = (1 - a) \, I_l(x + o_l(x)) + a \, I_r(x + o_r(x)), \quad a = \frac{n - l}{r - l}

    with offsets o along the motion of both clips, blended with the same weights. Where one of the two points lies
    outside the picture, only the other is used. At x1, pictures have detail that small errors of the motion would blur.

    Cells of 8 x 8 sensor pixels that move faster are computed, and those where the spikes contradict an interpolated
    picture, see :func:`lightning_modules.inference.rest.find_misfits`.

    Convention:
        For frames larger than a tile, states of key frames are stored in half precision: 0.27 GiB at x4 and
        1000 x 1000 sensor pixels. Pictures change by 0.03 of an 8-bit step (rms).

    Args:
        network: network of :mod:`lightning_modules.networks`.
        future: later key frames that a picture may wait for; only for networks with a state.
        tile: largest side of a tile in sensor pixels, 0 for no tiles; default: 256, or 512 on a GPU.
        psnr_tolerance: PSNR in dB that a picture may lose to save work. Above 0, the network runs only where the spikes
            show motion, see :class:`lightning_modules.inference.rest.Rest`, and less often where it is slow; the first
            picture is always complete.
        self_ensemble: as of :func:`lightning_modules.inference.predict.predict`; above 1, every clip is reconstructed
            alone, without a state.

    Attributes:
        calibration: of the sensor; if set, the spikes are those that it fired, and are corrected for the network.
        computed: cells (h, w) that the network computed of every picture of the last group, with a tolerance.

    Raises:
        ValueError: ``tile``, ``future`` or the tolerance is negative; ``future`` is for a network without a state, or
            combined with a tolerance; or a tolerance is for a network without a ``halo``.

    Example:
        >>> from lightning_modules.networks import CSCSR
        >>> network = CSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
        >>> maker = FilmMaker(network, psnr_tolerance=0.1)
        >>> maker(torch.zeros(2, 41, 12, 10), [20, 23]).shape
        torch.Size([2, 3, 24, 20])
    """

    def __init__(
        self,
        network: Network,
        future: int = 0,
        tile: int | None = None,
        psnr_tolerance: float = 0.0,
        self_ensemble: int = 1,
    ) -> None:
        kind = type(network).__name__
        self.carries_on = isinstance(network, RecurrentCSCSR) and self_ensemble == 1
        if isinstance(future, bool) or not isinstance(future, int) or future < 0:
            raise ValueError(f"future: expected a whole number >= 0, got {future!r}")
        if future and not self.carries_on:
            raise ValueError(f"future: expected 0, as {kind} takes single clips, got {future}")
        check_views(self_ensemble)
        if not 0 <= psnr_tolerance < math.inf:
            raise ValueError(f"psnr_tolerance: expected 0 dB or more, got {psnr_tolerance}")
        if psnr_tolerance and future:
            raise ValueError(f"psnr_tolerance: expected 0 with future, got {psnr_tolerance}")
        if psnr_tolerance and network.halo is None:
            raise ValueError(f"psnr_tolerance: expected 0 for {kind}, run on whole pictures only, got {psnr_tolerance}")
        self.network, self.future, self.self_ensemble = network, future, self_ensemble
        on_gpu = any(part.is_cuda for part in network.parameters())
        self.tile = (TILE_ON_GPU if on_gpu else TILE) if tile is None else tile
        if self.tile < 0:
            raise ValueError(f"tile: expected 0 pixels or more, got {tile}")
        self.calibration: Calibration | None = None
        self._last: _Made | None = None
        self._known: _Known | None = None
        self.rest: Rest | None = None
        self.computed: list[Tensor] = []
        self._interpolates = psnr_tolerance > 0 and network.takes_flow and network.scale > 1
        if psnr_tolerance:
            self.rest = Rest(network.scale, network.pattern, network.settings["alpha"], network.noise_level)

    @property
    def warm_up(self) -> int:
        """Number of pictures before another that visibly affect it."""
        return max(self.network.warm_up if self.carries_on else 0, Rest.warm_up if self.rest else 0)

    def together(self, every: float) -> int:
        """Return how many pictures are made together if they are ``every`` clocks apart, after the first group."""
        if not self._interpolates or 2 * every > self.network.frames:
            return self.future + 1
        return max(int(_TOGETHER / every), 2)

    def save(self, path: Path, clock: int) -> None:
        """Write the state after a picture, from which a film continues as if it had not stopped."""
        torch.save((clock, self._last, self._known, self.rest), state := BytesIO())
        write_whole(path, state.getbuffer())

    def load(self, path: Path, before: int, device: torch.device) -> int:
        """Read a state of an earlier clock and return that; without one, nothing changes, and -1 is returned."""
        with suppress(Exception), torch.serialization.safe_globals([_Made, _Known, Rest]):
            clock, *state = torch.load(path, device, weights_only=True)
            if clock < before:
                self._last, self._known, self.rest = state
                return clock
        return -1

    @torch.no_grad()
    def __call__(
        self, spikes: Tensor, clocks: Sequence[int], static: bool = False, exposure: float | Tensor = 1.0
    ) -> Tensor:
        """Return the pictures of consecutive clips.

        Args:
            spikes: (G, N, H, W).
            clocks: clock of the middle frame of each clip, increasing.
            static: nothing moves.
            exposure: factor of the pictures before they are clamped, a number or (G, 1, 1, 1).

        Returns:
            rgb (G, 3, s H, s W), in [0, 1].
        """
        if len(clocks) != len(spikes) or any(after <= before for before, after in pairwise(clocks)):
            raise ValueError(f"clocks: expected {len(spikes)} increasing ones, got {list(clocks)}")
        if self.rest is not None and not static:
            light = torch.as_tensor(exposure).flatten().expand(len(spikes)).tolist()
            clips = spikes.split(1)
            group = _Group(clocks, clips, light, self.network.settings["alpha"])
            group.corrected = cache(lambda n: correct_spikes(clips[n], self.calibration, self.network.pattern))
            pictures, self.computed = [], []
            for n in range(len(clocks)):
                pictures.append(self._where_it_moves(group, n))
                self.computed.append(self.rest.computed)
            return torch.stack(pictures) if len(pictures) > 1 else pictures[0][None]
        spikes = correct_spikes(spikes, self.calibration, self.network.pattern)
        return self._made(spikes, list(clocks), None, static, exposure)

    def _where_it_moves(self, group: _Group, n: int) -> Tensor:
        """Return a picture of which only moving parts are computed; the state of the other parts is kept."""
        clips, clock, exposure = group.clips[n], group.clocks[n], group.exposures[n]
        whole, before, scale = Box(0, 0, *clips.shape[-2:]), self._known, self.network.scale
        if group.ahead is not None and group.ahead[0] == n:
            _, self._last, self._known = group.ahead
            group.ahead, before = None, self._known
        if before is not None and clock - before.clock > self.network.frames:
            before = None
        state = None if before is None else before.state
        after = clock

        def make(box: Box, static: bool) -> Tensor:
            nonlocal state, after
            last = self._last
            if (last is None or last.clock != clock) and box == whole and not static:
                between = self._between(group, n)
                if between is not None:
                    after = before and before.clock
                    return between
                last = self._last = self._whole(group, n)
                state = self._known.state if self.carries_on else None
            if last is not None and last.clock == clock:
                return box.of(last.rgb[0], scale=scale).clone()
            rgb, part = self._part(group, n, box, static, before)
            if part is not None and box == whole:
                state = part
            elif part is not None:
                state = state.clone() if state is before.state else state
                box.of(state).copy_(part)
            return rgb

        rgb = self.rest(clips[0], clock, make, exposure, self.calibration)
        self._known = None if state is None else _Known(after, state)
        return rgb

    def _part(
        self, group: _Group, n: int, box: Box, static: bool, before: _Known | None
    ) -> tuple[Tensor, Tensor | None]:
        """Return the network's picture of a box, and its state."""
        clip = group.corrected(n)
        whole = Box(0, 0, *clip.shape[-2:])
        outer, near = box.grown(SEEN, whole), box.grown(AROUND, whole)
        flow = self.network.resolve_flow(near.of(clip), None, static)
        flow = None if flow is None else outer.of(flow, near[:2])
        if self.carries_on:
            self._known = None if before is None else _Known(before.clock, outer.of(before.state))
        rgb = self._made(outer.of(clip), [group.clocks[n]], flow, flow is None, group.exposures[n])[0]
        state = box.of(self._known.state, outer[:2]) if self.carries_on else None
        return box.of(rgb, outer[:2], self.network.scale), state

    def _whole(self, group: _Group, n: int) -> _Made:
        """Return the network's picture of a clip, and what an interpolation needs."""
        clip = group.corrected(n)
        flow = self.network.resolve_flow(clip, None, False)
        rgb = self._made(clip, [group.clocks[n]], flow, flow is None, group.exposures[n])
        joint = flow.mean(dim=1) if flow is not None and flow.ndim == 6 else flow  # one motion for all colours
        return _Made(group.clocks[n], rgb, joint, group.light(n)[0])

    def _between(self, group: _Group, n: int) -> Tensor | None:
        """Return a picture between the last one of the network and a later one, or None if motion is too fast."""
        left, clocks, last = self._last, group.clocks, len(group.clocks) - 1
        if not self._interpolates or left is None or left.flow is None:
            return None
        if left.flow.shape[-2:] != group.clips[n].shape[-2:]:
            return None
        if group.ahead is None:
            spans = {m: clocks[m] - left.clock for m in range(last, n, -1)}
            near = (m for m, span in spans.items() if span <= self.network.frames)
            m = next((m for m in near if self._fast(left, spans[m]).float().mean() <= _MOST), None)
            if m is None:
                return None
            before = self._known
            group.ahead = m, self._whole(group, m), self._known
            self._known = before
        right = group.ahead[1]
        span = right.clock - left.clock
        cells = self._fast(left, span) | self._fast(right, span)
        if span > self.network.frames or cells.float().mean() > _MOST:
            return None
        rgb = self._interpolate(left, right, clocks[n]).float()
        scale, (light, spike) = self.network.scale, group.light(n)
        pairs = (light, rgb), (left.light, left.rgb), (right.light, right.rgb)
        off = (seen - bin_to_sensor(shown[0].float(), self.network.pattern, scale=scale) for seen, shown in pairs)
        cells = cells | find_misfits(*off, spike)
        near, whole, before = grown(cells), Box(0, 0, *light.shape), self._known
        if near.float().mean() > _MOST:
            return None
        for box, _ in boxes_around(near, near, whole):
            part, _ = self._part(group, n, box, False, before)
            box.of(rgb[0], scale=scale).lerp_(part.float(), blend(cells, box, scale))
        self._known, self.rest.computed = before, near
        return rgb[0]

    def _fast(self, made: _Made, span: float) -> Tensor:
        """Return the cells (h, w) that move too far in some clocks for a picture between."""
        first, middle, last = self.network.flow_times
        clocks = made.flow.new_tensor([middle - first, last - middle])[:, None, None]
        speed = (made.flow[0].square().sum(1).sqrt() / clocks).amax(0, keepdim=True)
        parts = F.avg_pool2d(speed, CELL // 2, ceil_mode=True)
        return span * F.max_pool2d(parts, 2, ceil_mode=True)[0] > _SLOW[self.carries_on]

    def _made(
        self, spikes: Tensor, clocks: list[int], flow: Tensor | None, static: bool, exposure: float | Tensor
    ) -> Tensor:
        """Return the network's pictures of clips."""
        if self.carries_on:
            return self._carried_on(spikes, clocks, flow, static).mul_(exposure).clamp_(0, 1)
        how = {"tile": self.tile, "self_ensemble": self.self_ensemble}
        return predict(self.network, spikes, flow, static, exposure=exposure, **how)

    def _interpolate(self, left: _Made, right: _Made, clock: int) -> Tensor:
        share = (clock - left.clock) / (right.clock - left.clock)
        scale, whole = self.network.scale, Box(0, 0, *left.flow.shape[-2:])
        first, middle, last = self.network.flow_times
        to_first, to_last = torch.lerp(left.flow, right.flow, share).unbind(1)
        times = [middle + made.clock - clock for made in (left, right)]
        offsets = linear_motion(to_first, to_last, times, first=first, middle=middle, last=last)

        def run(box: Box) -> Tensor:
            near = box.grown(reach(offsets, box, whole, 2), whole)
            total = weights = 0.0
            for made, offset, weight in zip((left, right), offsets.unbind(1), (1 - share, share), strict=True):
                flow = upsample_flow(near.of(offset), scale)
                inside = _ends_inside(flow, near, whole, scale)
                weight = weight * torch.where(inside, 1.0, 1e-6)
                total = total + weight * _warp(near.of(made.rgb, scale=scale), flow)
                weights = weights + weight
            return box.of((total / weights).clamp_(0, 1), near[:2], scale)

        return tiled(run, whole, self.tile, lambda _: 0, scale)

    def _carried_on(self, spikes: Tensor, clocks: list[int], flow: Tensor | None, static: bool) -> Tensor:
        """Return the pictures of key frames that use their neighbours, (G, 3, s H, s W), not clamped."""
        network, whole = self.network, Box(0, 0, *spikes.shape[-2:])
        clips = spikes.split(1)
        given = [None] * len(clips) if flow is None else flow.split(1)
        flows = [network.resolve_flow(clip, way, static) for clip, way in zip(clips, given, strict=True)]
        features = {n: self._features(clip, flows[n], whole) for n, clip in enumerate(clips)}

        def meet(n: int, *around: _Known | None) -> _Known:
            neighbors = []
            for known in around:
                away = known.clock - clocks[n] if known else math.inf
                if abs(away) <= network.frames:
                    neighbors.append((known.state, None if flows[n] is None else network.flow_to(flows[n], away)))
            return _Known(clocks[n], self._advance(features[n], clips[n], neighbors, whole))

        group = range(len(clips))
        behind = list(islice(read_from_end(group, meet), len(group) - 1))
        rgb = None
        for n, known in enumerate(read_forward(group, meet, self._known, behind)):
            self._known = known
            del features[n]  # frees unused features, which are large
            picture = network.picture(known.state)
            if rgb is None:
                rgb = picture.new_empty(len(clips), *picture.shape[1:])
            rgb[n] = picture[0]
        return rgb.to(self._dtype)

    @property
    def _dtype(self) -> torch.dtype:
        return self.network.reconstruction.rgb.weight.dtype

    def _features(self, spikes: Tensor, flow: Tensor | None, whole: Box) -> Tensor:
        def run(outer: Box) -> Tensor:
            features = self.network.features(outer.of(spikes), None if flow is None else outer.of(flow))
            return self._halved(features, whole)

        return tiled(run, whole, self.tile, lambda box: reach(flow, box, whole, self.network.halo))

    def _advance(
        self, features: Tensor, spikes: Tensor, neighbors: list[tuple[Tensor, Tensor | None]], whole: Box
    ) -> Tensor:
        def moved(outer: Box, state: Tensor, way: Tensor | None) -> Tensor:
            near = outer.grown(reach(way, outer, whole, 2), whole)
            state = self.network.moved(near.of(state).to(self._dtype), None if way is None else near.of(way))
            return outer.of(state, near[:2])

        def run(outer: Box) -> Tensor:
            around = [moved(outer, *neighbor) for neighbor in neighbors]
            seen = outer.of(features).to(self._dtype), outer.of(spikes)
            state = self.network.advance(*seen, *around)
            return self._halved(state, whole)

        return tiled(run, whole, self.tile, lambda _: self.network.halo)

    def _halved(self, planes: Tensor, whole: Box) -> Tensor:
        """Return planes in half precision for frames larger than a tile, to save memory."""
        large = 0 < self.tile < max(whole.bottom, whole.right)
        return planes.half() if large and planes.dtype == torch.float32 else planes


def _warp(image: Tensor, flow: Tensor) -> Tensor:
    """Return an image warped like :func:`spikekit.flow_warp`, but not blurred: second differences undo the mean."""
    across = F.pad(image[..., :-2] - 2 * image[..., 1:-1] + image[..., 2:], (1, 1))
    down = F.pad(image[..., :-2, :] - 2 * image[..., 1:-1, :] + image[..., 2:, :], (0, 0, 1, 1))
    warped, across, down = flow_warp(torch.cat([image, across, down], 1), flow.to(image)).chunk(3, 1)
    x, y = (flow - flow.floor()).split(1, 1)
    return warped - (x - x * x) / 2 * across - (y - y * y) / 2 * down


def _ends_inside(flow: Tensor, near: Box, whole: Box, scale: int) -> Tensor:
    """Return a mask (1, 1, h, w) of the vectors of a box's flow (1, 2, h, w) that end inside the picture."""
    rows, columns = (torch.arange(side, device=flow.device) for side in flow.shape[-2:])
    x, y = flow[:, 0] + columns + scale * near.left, flow[:, 1] + rows[:, None] + scale * near.top
    return ((x >= 0) & (x <= scale * whole.right - 1) & (y >= 0) & (y <= scale * whole.bottom - 1)).unsqueeze(1)
