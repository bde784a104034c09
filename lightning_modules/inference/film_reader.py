"""Films by a network that carries a state from one key frame to the next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import islice, pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from lightning_modules.inference.tiles import TILE, Box, reach, tiled
from lightning_modules.networks import Network, RecurrentCSCSR
from lightning_modules.networks.recurrent_cscsr import read_forward, read_from_end


class _Known(NamedTuple):
    clock: int
    state: Tensor


class FilmReader:
    r"""Makes the pictures of a film, group by group, and keeps the state of the last key frame in between.

    Convention:
        A key frame's neighbour helps if it is at most a clip's length away; further away nothing is known of the
        motion. So a reader may be given the groups of another part of the film at any time.

        Where frames are larger than a tile, what is known of a key frame waits in half precision: 0.27 GiB at x4 and
        1000 x 1000 sensor pixels. Pictures change by 0.03 of an 8-bit step (rms).

    Args:
        network: a network for films.
        tile: side of the tiles in sensor pixels, 0 for none.

    Example:
        >>> network = RecurrentCSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
        >>> reader = FilmReader(network)
        >>> reader(torch.zeros(2, 41, 12, 10), [20, 40]).shape
        torch.Size([2, 3, 24, 20])
    """

    def __init__(self, network: RecurrentCSCSR, tile: int = TILE) -> None:
        self.network, self.tile = network, tile
        self._last: _Known | None = None

    @property
    def _dtype(self) -> torch.dtype:
        return self.network.reconstruction.rgb.weight.dtype

    @torch.no_grad()
    def __call__(
        self, spikes: Tensor, clocks: Sequence[int], flow: Tensor | None = None, static: bool = False
    ) -> Tensor:
        """Return the pictures of key frames that follow each other.

        A single one knows the key frame before; of more, which are read from their end first, all but the last know
        the one behind them as well.

        Args:
            spikes: (G, N, H, W), the clips of a group.
            clocks: number of the key frame of each, increasing.
            flow: (G, 2, 2, H, W), as the network takes it; when not given, the network's own estimate.
            static: nothing moves, instead of a flow.

        Returns:
            rgb (G, 3, s H, s W), not clamped.

        Raises:
            ValueError: as many clocks as clips, increasing ones, were expected.
        """
        if len(clocks) != len(spikes) or any(after <= before for before, after in pairwise(clocks)):
            raise ValueError(f"clocks: expected {len(spikes)} increasing ones, got {list(clocks)}")
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
        for n, known in enumerate(read_forward(group, meet, self._last, behind)):
            self._last = known
            del features[n]  # of a large film what a group remembers fills the memory
            picture = network.picture(known.state)
            if rgb is None:
                rgb = picture.new_empty(len(clips), *picture.shape[1:])
            rgb[n] = picture[0]
        return rgb.to(self._dtype)

    def _features(self, spikes: Tensor, flow: Tensor | None, whole: Box) -> Tensor:
        def run(outer: Box) -> Tensor:
            features = self.network.features(outer.of(spikes), None if flow is None else outer.of(flow))
            return self._kept(features, whole)

        return tiled(run, whole, self.tile, lambda box: reach(flow, box, whole, self.network.halo))

    def _advance(
        self, features: Tensor, spikes: Tensor, neighbors: list[tuple[Tensor, Tensor | None]], whole: Box
    ) -> Tensor:
        dtype = self._dtype

        def moved(outer: Box, state: Tensor, way: Tensor | None) -> Tensor:
            near = outer.grown(reach(way, outer, whole, 2), whole)
            state = self.network.moved(near.of(state).to(dtype), None if way is None else near.of(way))
            return outer.of(state, near[:2])

        def run(outer: Box) -> Tensor:
            around = [moved(outer, *neighbor) for neighbor in neighbors]
            return self._kept(self.network.advance(outer.of(features).to(dtype), outer.of(spikes), around), whole)

        return tiled(run, whole, self.tile, lambda _: self.network.halo)

    def _kept(self, planes: Tensor, whole: Box) -> Tensor:
        """What waits for its neighbours; where frames are larger than a tile, in half precision: half the memory."""
        large = 0 < self.tile < max(whole.bottom, whole.right)
        return planes.half() if large and planes.dtype == torch.float32 else planes


def check_future(network: Network, future: int) -> int:
    """Return how many key frames a picture may wait for.

    Raises:
        ValueError: less than 0, or any for a network that takes every clip by itself.
    """
    if future < 0 or (future and not isinstance(network, RecurrentCSCSR)):
        kind = type(network).__name__
        most = "0 or more" if isinstance(network, RecurrentCSCSR) else f"0, as {kind} takes every clip by itself"
        raise ValueError(f"future: expected {most}, got {future}")
    return future
