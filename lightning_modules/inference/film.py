"""Films: pictures from a stream of spikes, as it arrives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache, partial
from io import BytesIO
from itertools import chain, count, islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightning_modules.inference.clips import clip_in_light, clips_around, film_groups, join_frames
from lightning_modules.inference.predict import check_views, predict
from lightning_modules.inference.rest import AROUND, SEEN, Rest
from lightning_modules.inference.tiles import TILE, TILE_ON_GPU, Box, reach, tiled
from lightning_modules.networks import Network, RecurrentCSCSR
from lightning_modules.networks.recurrent_cscsr import read_forward, read_from_end
from spikekit import Calibration, correct_spikes, flow_warp, linear_motion, upsample_flow
from spikekit.check import check_planes, check_positive, check_whole
from spikekit.io.whole_file import whole_file
from spikekit.recording import white_rate


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
    interpolated: int = 0,
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

        With ``future`` or ``interpolated``, pictures come in groups, see :class:`FilmMaker`. A picture is then delayed
        by up to ``(future + 1) * (interpolated + 1) - 1`` pictures, and the group is kept in memory.

        The white level is the same in all pictures: ``white``, else the level that 99.9 % of the pixels of the first
        clip do not exceed.

    Args:
        network: network of :mod:`lightning_modules.networks`, on the device of the chunks.
        chunks: spikes (T, H, W) of any length, as :func:`spikekit.iter_spikes` returns with a ``chunk``; they begin
            with the network's Bayer phase.
        every: clocks between two pictures.
        future: later key frames that a picture may wait for, see :class:`FilmMaker`.
        interpolated: pictures interpolated between two pictures of the network, see :class:`FilmMaker`.
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
    maker = FilmMaker(network, future, interpolated, **how)
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
    for group in film_groups(joint, maker.future, maker.interpolated):
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
    """A picture of the network and the motion of its clip."""

    clock: int
    rgb: Tensor
    flow: Tensor | None


class _Known(NamedTuple):
    """The state of a :class:`RecurrentCSCSR` at a key frame."""

    clock: int
    state: Tensor


class FilmMaker:
    r"""Make the pictures of a film, group by group.

    A :class:`lightning_modules.networks.RecurrentCSCSR` passes the state of a key frame to the next. With ``future``,
    groups have ``future + 1`` key frames, which take a backward pass before the forward pass, so that all but the last
    also use the next key frame. Neighbours further away than the length of a clip are not used, as their motion is
    unknown; groups from any other place of a film are therefore allowed.

    An interpolated picture between those of the clocks l and r is

    .. math:: I_n(x) = (1 - a) \, I_l(x + o_l(x)) + a \, I_r(x + o_r(x)), \quad a = \frac{n - l}{r - l}

    with offsets o along the motion of both clips, blended with the same weights. Where one of the two points lies
    outside the picture, only the other is used.

    Convention:
        The network makes the last picture of every ``interpolated + 1`` and the last of a group. If the previous
        picture is further away than the length of a clip, it also makes the first.

        For frames larger than a tile, states of key frames are stored in half precision: 0.27 GiB at x4 and
        1000 x 1000 sensor pixels. Pictures change by 0.03 of an 8-bit step (rms).

    Args:
        network: network of :mod:`lightning_modules.networks`.
        future: later key frames that a picture may wait for; only for networks with a state.
        interpolated: pictures interpolated between two pictures of the network.
        tile: largest side of a tile in sensor pixels, 0 for no tiles; default: 256, or 512 on a GPU.
        psnr_tolerance: PSNR in dB that a picture may lose to save work. Above 0, the network runs only where the spikes
            show motion, see :class:`lightning_modules.inference.rest.Rest`; the first picture is always complete.
        how: ``self_ensemble`` of :func:`lightning_modules.inference.predict.predict`, with which every clip is
            reconstructed alone, without a state.

    Attributes:
        calibration: of the sensor; if set, the spikes are those that it fired, and are corrected for the network.

    Raises:
        ValueError: ``future`` for a network without a state; ``interpolated`` for a network without a motion estimate;
            a negative number; an option that the network does not support; or a tolerance that is negative, is combined
            with ``future`` or ``interpolated``, or is for a network without a ``halo``.

    Example:
        >>> from lightning_modules.networks import CSCSR
        >>> network = CSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
        >>> maker = FilmMaker(network, interpolated=1)
        >>> maker(torch.zeros(2, 41, 12, 10), [20, 23]).shape
        torch.Size([2, 3, 24, 20])
    """

    def __init__(
        self,
        network: Network,
        future: int = 0,
        interpolated: int = 0,
        tile: int | None = None,
        psnr_tolerance: float = 0.0,
        **how: Any,
    ) -> None:
        kind = type(network).__name__
        self.carries_on = isinstance(network, RecurrentCSCSR) and how.get("self_ensemble", 1) == 1
        for name, number in (("future", future), ("interpolated", interpolated)):
            if isinstance(number, bool) or not isinstance(number, int) or number < 0:
                raise ValueError(f"{name}: expected a whole number >= 0, got {number!r}")
        if future and not self.carries_on:
            raise ValueError(f"future: expected 0, as {kind} takes single clips, got {future}")
        if interpolated and not network.takes_flow:
            raise ValueError(f"interpolated: expected 0, as {kind} estimates no motion of a clip, got {interpolated}")
        check_views(how.get("self_ensemble", 1))
        if not 0 <= psnr_tolerance < math.inf:
            raise ValueError(f"psnr_tolerance: expected 0 dB or more, got {psnr_tolerance}")
        if psnr_tolerance and (future or interpolated):
            raise ValueError(f"psnr_tolerance: expected 0 with future or interpolated pictures, got {psnr_tolerance}")
        if psnr_tolerance and network.halo is None:
            raise ValueError(f"psnr_tolerance: expected 0 for {kind}, run on whole pictures only, got {psnr_tolerance}")
        self.network, self.future, self.interpolated, self._how = network, future, interpolated, how
        on_gpu = any(part.is_cuda for part in network.parameters())
        self.tile = (TILE_ON_GPU if on_gpu else TILE) if tile is None else tile
        self.calibration: Calibration | None = None
        self._last: _Made | None = None
        self._known: _Known | None = None
        self.rest: Rest | None = None
        if psnr_tolerance:
            self.rest = Rest(network.scale, network.pattern, network.settings["alpha"], network.noise_level > 0)

    @property
    def warm_up(self) -> int:
        """Number of groups before another that visibly affect it."""
        known = -(-self.network.warm_up // (self.future + 1)) if self.carries_on else 0
        return max(known, min(self.interpolated, 1), Rest.warm_up if self.rest else 0)

    def save(self, path: Path, clock: int) -> None:
        """Write the state after a picture, from which a film continues as if it had not stopped."""
        torch.save((clock, self._last, self._known, self.rest), state := BytesIO())
        with whole_file(path) as file:
            file.write(state.getbuffer())

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

        Raises:
            ValueError: the number of clocks differs from that of clips, or they do not increase.
        """
        if len(clocks) != len(spikes) or any(after <= before for before, after in pairwise(clocks)):
            raise ValueError(f"clocks: expected {len(spikes)} increasing ones, got {list(clocks)}")
        if self.rest is not None and not static:
            light = torch.as_tensor(exposure).flatten().expand(len(spikes)).tolist()
            pictures = [*map(self._where_it_moves, spikes.split(1), clocks, light)]
            return torch.cat(pictures) if len(pictures) > 1 else pictures[0]
        spikes = correct_spikes(spikes, self.calibration, self.network.pattern)
        if not self.interpolated:
            return self._made(spikes, list(clocks), None, static, exposure)
        every, total = self.interpolated + 1, len(clocks)
        see = partial(self._see, spikes, clocks, static, exposure)
        known = [self._last]
        if self._last is None or clocks[0] - self._last.clock > self.network.frames:
            known = see([0])
        keys = {*range(every - 1, total, every), total - 1}
        known += see(sorted(n for n in keys if clocks[n] > known[0].clock))
        self._last = known[-1]
        pictures = {made.clock: made.rgb for made in known}
        for left, right in pairwise(known):
            between = [clock for clock in clocks if left.clock < clock < right.clock]
            pictures |= {clock: self._interpolate(left, right, clock) for clock in between}
        return torch.cat([pictures[clock] for clock in clocks])

    def _where_it_moves(self, spikes: Tensor, clock: int, exposure: float) -> Tensor:
        """Return a picture of which only moving parts are computed; the state of the other parts is kept."""
        whole, before, state = Box(0, 0, *spikes.shape[-2:]), self._known, None
        if before is not None and clock - before.clock <= self.network.frames:
            state = before.state
        corrected = cache(partial(correct_spikes, spikes, self.calibration, self.network.pattern))

        def make(box: Box, static: bool) -> Tensor:
            nonlocal state
            outer, near = box.grown(SEEN, whole), box.grown(AROUND, whole)
            flow = self.network.resolve_flow(near.of(corrected()), None, static)
            flow = None if flow is None else outer.of(flow, near[:2])
            if self.carries_on:
                self._known = None if state is None else _Known(before.clock, outer.of(before.state))
            rgb = self._made(outer.of(corrected()), [clock], flow, flow is None, exposure)[0]
            if self.carries_on:
                part = self._known.state
                if box == whole:
                    state = part
                else:
                    state = state.clone() if state is before.state else state
                    box.of(state).copy_(box.of(part, outer[:2]))
            return box.of(rgb, outer[:2], self.network.scale)

        rgb = self.rest(spikes[0], clock, make, exposure, self.calibration)
        self._known = None if state is None else _Known(clock, state)
        return rgb[None]

    def _made(
        self, spikes: Tensor, clocks: list[int], flow: Tensor | None, static: bool, exposure: float | Tensor
    ) -> Tensor:
        """Return the network's pictures of clips."""
        if self.carries_on:
            return self._carried_on(spikes, clocks, flow, static).mul_(exposure).clamp_(0, 1)
        return predict(self.network, spikes, flow, static, exposure=exposure, tile=self.tile, **self._how)

    def _see(
        self, spikes: Tensor, clocks: Sequence[int], static: bool, exposure: float | Tensor, keys: list[int]
    ) -> list[_Made]:
        """Return the network's pictures of some clips of a group, and their motion."""
        if not keys:
            return []
        flows = [self.network.resolve_flow(spikes[n : n + 1], None, static) for n in keys]
        flow = None if flows[0] is None else torch.cat(flows)
        light = exposure[keys] if isinstance(exposure, Tensor) and exposure.ndim else exposure
        at = [clocks[n] for n in keys]
        rgb = self._made(spikes[keys], at, flow, flow is None, light)
        # one motion for all colours
        joint = [one.mean(dim=1) if one is not None and one.ndim == 6 else one for one in flows]
        return list(map(_Made, at, rgb.split(1), joint))

    def _interpolate(self, left: _Made, right: _Made, clock: int) -> Tensor:
        share = (clock - left.clock) / (right.clock - left.clock)
        if left.flow is None or right.flow is None:
            return torch.lerp(left.rgb, right.rgb, share)
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
                total = total + weight * flow_warp(near.of(made.rgb, scale=scale), flow.to(made.rgb))
                weights = weights + weight
            return box.of(total / weights, near[:2], scale)

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


def _ends_inside(flow: Tensor, near: Box, whole: Box, scale: int) -> Tensor:
    """Return a mask (1, 1, h, w) of the vectors of a box's flow (1, 2, h, w) that end inside the picture."""
    rows, columns = (torch.arange(side, device=flow.device) for side in flow.shape[-2:])
    x, y = flow[:, 0] + columns + scale * near.left, flow[:, 1] + rows[:, None] + scale * near.top
    return ((x >= 0) & (x <= scale * whole.right - 1) & (y >= 0) & (y <= scale * whole.bottom - 1)).unsqueeze(1)
