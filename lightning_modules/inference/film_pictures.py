"""Pictures of a film: some by the network, those between two of them by moving these along the motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightning_modules.inference.film_reader import FilmReader
from lightning_modules.inference.predict import predict
from lightning_modules.inference.tiles import TILE, Box, reach, tiled
from lightning_modules.networks import Network, RecurrentCSCSR, TwoSpanCSCSR
from spikekit import flow_warp, linear_motion, upsample_flow


class _Made(NamedTuple):
    clock: int
    rgb: Tensor
    flow: Tensor | None


class FilmPictures:
    r"""Makes the pictures of a film, group by group, and keeps what the next group needs.

    .. math:: I_n(x) = (1 - a) \, I_l(x + o_l(x)) + a \, I_r(x + o_r(x)), \quad a = \frac{n - l}{r - l}

    is an interpolated picture between those of the clocks l and r, where the offsets o follow the motion of both clips,
    taken together with the same shares. What comes from outside of one of the two is taken from the other alone.

    Convention:
        Of every ``interpolated + 1`` clips of a group the network sees the last, and the last of the group. Where the
        picture before the group is more than a clip's length away, it sees the first as well.

    Args:
        network: any of :mod:`lightning_modules.networks`.
        interpolated: pictures between two that the network makes.
        how: ``tile``, ``psnr_tolerance``, ``self_ensemble`` and ``done`` of
            :func:`lightning_modules.inference.predict.predict`; a
            :class:`~lightning_modules.networks.RecurrentCSCSR` takes ``tile`` alone.

    Raises:
        ValueError: ``interpolated`` is not a whole number, 0 or more, or above 0 for a network that estimates no motion
            or two of them; another argument than ``tile`` for a :class:`~lightning_modules.networks.RecurrentCSCSR`.

    Example:
        >>> from lightning_modules.networks import CSCSR
        >>> network = CSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
        >>> pictures = FilmPictures(network, interpolated=1)
        >>> pictures(torch.zeros(2, 41, 12, 10), [20, 23]).shape
        torch.Size([2, 3, 24, 20])
    """

    def __init__(self, network: Network, interpolated: int = 0, **how: Any) -> None:
        self.network, self.interpolated = network, check_interpolated(network, interpolated)
        self.tile = how.get("tile", TILE)
        if isinstance(network, RecurrentCSCSR):
            if how.keys() - {"tile"}:
                raise ValueError(f"how: expected tile with {type(network).__name__}, got {', '.join(how)}")
            reader = FilmReader(network, self.tile)

            def make(spikes: Tensor, clocks: list[int], flow: Tensor | None, static: bool, exposure: Any) -> Tensor:
                return reader(spikes, clocks, flow, static).mul_(exposure).clamp_(0, 1)
        else:

            def make(spikes: Tensor, clocks: list[int], flow: Tensor | None, static: bool, exposure: Any) -> Tensor:
                return predict(network, spikes, flow, static, exposure=exposure, **how)

        self._make: Callable[..., Tensor] = make
        self._last: _Made | None = None

    @torch.no_grad()
    def __call__(
        self, spikes: Tensor, clocks: Sequence[int], static: bool = False, exposure: float | Tensor = 1.0
    ) -> Tensor:
        """Return the pictures of clips that follow each other.

        Args:
            spikes: (G, N, H, W).
            clocks: number of the frame in the middle of each, increasing.
            static: nothing moves.
            exposure: what pictures are multiplied by before they are clamped, a number or (G, 1, 1, 1).

        Returns:
            rgb (G, 3, s H, s W), in [0, 1].
        """
        if not self.interpolated:
            return self._make(spikes, list(clocks), None, static, exposure)
        every, count = self.interpolated + 1, len(clocks)
        see = partial(self._see, spikes, clocks, static, exposure)
        known = [self._last]
        if self._last is None or clocks[0] - self._last.clock > self.network.frames:
            known = see([0])
        keys = {*range(every - 1, count, every), count - 1}
        known += see(sorted(n for n in keys if clocks[n] > known[0].clock))
        self._last = known[-1]
        pictures = {made.clock: made.rgb for made in known}
        for left, right in pairwise(known):
            between = [clock for clock in clocks if left.clock < clock < right.clock]
            pictures |= {clock: self._interpolated(left, right, clock) for clock in between}
        return torch.cat([pictures[clock] for clock in clocks])

    def _see(
        self, spikes: Tensor, clocks: Sequence[int], static: bool, exposure: float | Tensor, keys: list[int]
    ) -> list[_Made]:
        """The network's pictures of some clips of a group."""
        if not keys:
            return []
        flows = [self.network.resolve_flow(spikes[n : n + 1], None, static) for n in keys]
        flow = None if flows[0] is None else torch.cat(flows)
        light = exposure[keys] if isinstance(exposure, Tensor) and exposure.ndim else exposure
        at = [clocks[n] for n in keys]
        rgb = self._make(spikes[keys], at, flow, flow is None, light)
        return list(map(_Made, at, rgb.split(1), map(_joint, flows)))

    def _interpolated(self, left: _Made, right: _Made, clock: int) -> Tensor:
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


def _joint(flow: Tensor | None) -> Tensor | None:
    """A single motion for all colours."""
    return flow.mean(dim=1) if flow is not None and flow.ndim == 6 else flow


def _ends_inside(flow: Tensor, near: Box, whole: Box, scale: int) -> Tensor:
    """Where a flow (1, 2, h, w) of a box ends inside the picture, (1, 1, h, w)."""
    rows, columns = (torch.arange(side, device=flow.device) for side in flow.shape[-2:])
    x, y = flow[:, 0] + columns + scale * near.left, flow[:, 1] + rows[:, None] + scale * near.top
    return ((x >= 0) & (x <= scale * whole.right - 1) & (y >= 0) & (y <= scale * whole.bottom - 1)).unsqueeze(1)


def check_interpolated(network: Network, interpolated: int) -> int:
    """Return how many pictures are interpolated between two of a network.

    Raises:
        ValueError: no whole number, less than 0, or any for a network that does not estimate the motion of its clips,
            or does so twice.
    """
    if isinstance(interpolated, bool) or not isinstance(interpolated, int) or interpolated < 0:
        raise ValueError(f"interpolated: expected a whole number >= 0, got {interpolated!r}")
    if interpolated and (not network.takes_flow or isinstance(network, TwoSpanCSCSR)):
        kind = type(network).__name__
        raise ValueError(f"interpolated: expected 0, as {kind} estimates no motion of a whole clip, got {interpolated}")
    return interpolated
