"""CSCSR for films: the state of a key frame helps its neighbours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightning_modules.motion import MotionEstimator
from lightning_modules.networks.cscsr import CSCSR
from lightning_modules.networks.cscsr_config import CSCSRConfig
from lightning_modules.networks.layers import channels_last, conv, res_blocks, start_pixel_by_pixel
from lightning_modules.signatures import inherit_signature
from spikekit import flow_warp, upsample_flow
from spikekit.check import check_whole

State = TypeVar("State")


@dataclass(frozen=True)
class RecurrentCSCSRConfig(CSCSRConfig):
    """Configuration of a :class:`lightning_modules.networks.RecurrentCSCSR`.

    Args:
        fusion_width: channels where a key frame meets what is known of its neighbours.
        fusion_blocks: residual blocks there.
        memory: channels that are carried on beside the picture.

    Other fields: see :class:`CSCSRConfig`.

    Raises:
        ValueError: as :class:`CSCSRConfig`; colours that are not correlated, or a resolution other than the sensor's.
    """

    fusion_width: int = 64
    fusion_blocks: int = 3
    memory: int = 32
    size: str = "small"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reconstruction != "correlated" or self.resolution != "sensor":
            raise ValueError(
                "reconstruction, resolution: expected correlated and sensor, where key frames meet, "
                f"got {self.reconstruction} and {self.resolution}"
            )


class StateFusion(nn.Module):
    """Mixes the picture of a clip with those of its neighbours, where they agree; beside it goes a memory.

    Before it is trained it leaves the picture as it is. The weights are the same for both neighbours: a film may be
    read from either end.

    Shape:
        - Input: features :math:`(B, features, H, W)`, the clip's picture :math:`(B, picture, H, W)`, and the states of
          its neighbours, moved, :math:`(B, picture + memory, H, W)`, one or more
        - Output: a state
    """

    def __init__(self, features: int, picture: int, memory: int, width: int, blocks: int) -> None:
        super().__init__()
        self.picture = picture
        self.own = conv(features, width)
        self.neighbor = nn.Conv2d(picture + memory, width, 3, padding=1, bias=False)
        self.body = res_blocks(width, blocks)
        self.share = conv(width, picture)
        self.rest = conv(width, picture + memory)
        start_pixel_by_pixel(self)
        nn.init.zeros_(self.share.weight)
        nn.init.zeros_(self.rest.weight[:picture])

    def forward(self, features: Tensor, picture: Tensor, states: Sequence[Tensor]) -> Tensor:  # noqa: D102
        known, memories = zip(*(state.tensor_split([self.picture], dim=1) for state in states), strict=True)
        away = [other - picture for other in known]
        own = self.own(features)
        seen = [
            F.leaky_relu(own + self.neighbor(torch.cat(pair, dim=1)), 0.1) for pair in zip(away, memories, strict=True)
        ]
        joined = self.body(sum(seen))
        mixed = sum(self.share(joined + one).tanh() * change for one, change in zip(seen, away, strict=True))
        more, memory = self.rest(joined).tensor_split([self.picture], dim=1)
        return torch.cat([picture + mixed + more, memory], dim=1)


class RecurrentCSCSR(CSCSR):
    r"""CSCSR for films: the state of the key frame before, or of those on both sides, moved along the motion, helps.

    A clip by itself gives what CSCSR with the same weights would. The state of a key frame is its picture, whose
    temporal pixels are channels at the sensor's resolution, and a memory. The picture is moved at its own resolution,
    so that nothing finer than a sensor pixel is lost on the way, and compared with that of the present clip.

    Convention:
        A key frame's neighbour is ``every`` clocks away. The motion to it is that of its own clip, taken to go on as it
        is: no further estimate is needed.

    Args:
        *args: fields of :class:`RecurrentCSCSRConfig`, in its order.
        motion: as of :class:`CSCSR`.
        **settings: fields of :class:`RecurrentCSCSRConfig`, by name.

    Shape:
        - Input: spikes :math:`(B, N, H, W)` of a clip, as of :class:`CSCSR`; or :math:`(B, K, N, H, W)`, those around K
          key frames ``every`` clocks apart; optionally flows, :math:`(B, 2, 2, H, W)` or :math:`(B, K, 2, 2, H, W)`
        - Output: rgb :math:`(B, 3, s H, s W)` or :math:`(B, K, 3, s H, s W)`, not clamped

    Example:
        >>> network = RecurrentCSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
        >>> network(torch.zeros(1, 3, 41, 12, 10)).shape
        torch.Size([1, 3, 3, 24, 20])

    Reference:
        Chan et al., BasicVSR, CVPR 2021, and Fuoli et al., Efficient Video Super-Resolution through Recurrent Latent
        Space Propagation, ICCVW 2019, for the principle; the network is this project's own.
    """

    configuration = RecurrentCSCSRConfig
    warm_up = 8

    @inherit_signature(RecurrentCSCSRConfig)
    def __init__(self, *args: Any, motion: MotionEstimator | None = None, **settings: Any) -> None:
        super().__init__(*args, motion=motion, **settings)
        config = self.config
        self.fusion = StateFusion(
            config.end_width or config.width,
            self.colors * self.scale**2,
            config.memory,
            config.fusion_width,
            config.fusion_blocks,
        )

    def forward(
        self,
        spikes: Tensor,
        flow: Tensor | None = None,
        static: bool = False,
        every: int = 20,
        future: int = 0,
        alpha: float | Tensor | None = None,
        noise: float | Tensor | None = None,
    ) -> Tensor:
        """Return the picture of a clip, or those of a film.

        Args:
            spikes: see the class.
            flow: likewise.
            static: nothing moves, instead of a flow.
            every: clocks between two key frames.
            future: key frames that a picture may wait for; see :meth:`film`.
            alpha: see :class:`CSCSR`; of films, one a film.
            noise: likewise.
        """
        if spikes.ndim == 5:
            return self.film(spikes, flow, static, every, future, alpha, noise)[-1]
        self.check_spikes(spikes)
        features = self.features(spikes, self.resolve_flow(spikes, flow, static), noise)
        return self._exposed(self.picture(self.advance(features, spikes)), alpha)

    def film(
        self,
        spikes: Tensor,
        flow: Tensor | None = None,
        static: bool = False,
        every: int = 20,
        future: int = 0,
        alpha: float | Tensor | None = None,
        noise: float | Tensor | None = None,
    ) -> list[Tensor]:
        """Return the pictures of a film, as they are after every time that it was read.

        It is read in groups of ``future + 1`` key frames: a single one knows the one before it; more are read from
        their end and then forward, so that a key frame knows both its neighbours.

        Args:
            spikes: (B, K, N, H, W).
            flow: (B, K, 2, 2, H, W), or None to ask the estimator.
            static: nothing moves, instead of a flow.
            every: clocks between two key frames.
            future: key frames that a picture may wait for.
            alpha: see :class:`CSCSR`; a number or (B,).
            noise: likewise.

        Returns:
            rgb (B, K, 3, s H, s W), once or, with a ``future``, twice: the last is the best.

        Raises:
            ValueError: ``every`` is not a whole number above 0, or ``future`` a negative one; sizes that do not fit.
        """
        every, size = check_whole("every", every), check_whole("future + 1", future + 1)
        clips = spikes.flatten(0, 1)
        self.check_spikes(clips)
        flow = self.resolve_flow(clips, None if flow is None else flow.flatten(0, 1), static)
        if isinstance(noise, Tensor) and noise.ndim:
            noise = noise.repeat_interleave(spikes.shape[1])
        features = self.features(clips, flow, noise).unflatten(0, spikes.shape[:2])
        flow = None if flow is None else flow.unflatten(0, spikes.shape[:2])

        def meet(n: int, before: Tensor | None, after: Tensor | None) -> Tensor:
            ways = (None if flow is None else self.flow_to(flow[:, n], clocks) for clocks in (-every, every))
            around = zip((before, after), ways, strict=True)
            neighbors = [self.moved(state, way) for state, way in around if state is not None]
            return self.advance(features[:, n], spikes[:, n], *neighbors)

        earlier, final, last = [], [], None
        for first in range(0, spikes.shape[1], size):
            group = range(first, min(first + size, spikes.shape[1]))
            behind = list(read_from_end(group, meet)) if len(group) > 1 else []
            once, twice = behind[::-1], list(read_forward(group, meet, last, behind[:-1]))
            earlier += map(self.picture, once or twice)
            final += map(self.picture, twice)
            last = twice[-1]
        readings = [earlier, final] if future else [final]
        return [self._exposed(torch.stack(pictures, dim=1), alpha) for pictures in readings]

    @torch.no_grad()
    def scale_picture(self, factor: float) -> None:  # noqa: D102
        super().scale_picture(factor)
        # key frames meet as before: what is read of pictures, and what is added to them
        picture = self.colors * self.scale**2
        self.fusion.neighbor.weight[:, :picture] /= factor
        self.fusion.rest.weight[:picture] *= factor
        self.fusion.rest.bias[:picture] *= factor

    def features(self, spikes: Tensor, flow: Tensor | None, noise: float | Tensor | None = None) -> Tensor:
        """Return what a picture is made of, (B, width, H, W), from a clip alone; without flow nothing moves."""
        spikes = spikes.to(self.reconstruction.rgb.weight.dtype)
        told = self._told(noise, spikes)
        return self.reconstruction.features(self._colors(spikes, flow, **told), **told)

    def advance(self, features: Tensor, spikes: Tensor, *neighbors: Tensor) -> Tensor:
        """Return the state of a key frame, given its features, its clip, and the states of its neighbours, moved to it.

        Returns:
            Its picture, as channels, and a memory, (B, 3 s^2 + memory, H, W), or (B, s^2 + memory, H, W) of grey.
        """
        features = channels_last(features)
        rgb = self.reconstruction.rgb(features)
        if self.config.skip:
            rgb = rgb + self._base(spikes.to(rgb.dtype))
        picture = F.pixel_unshuffle(rgb, self.scale)
        if neighbors:
            return self.fusion(features, picture, neighbors)
        nothing = picture.new_zeros(len(picture), self.config.memory, *picture.shape[-2:])
        return torch.cat([picture, nothing], dim=1)

    def _parted(self, state: Tensor) -> list[Tensor]:
        return state.tensor_split([self.colors * self.scale**2], dim=1)

    def picture(self, state: Tensor) -> Tensor:
        """Return the picture of a state, (B, 3, s H, s W)."""
        return F.pixel_shuffle(self._parted(state)[0], self.scale)

    def flow_to(self, flow: Tensor, clocks: int) -> Tensor:
        """Return the flow, (B, 2, H, W), to what is so many clocks later, or earlier where they are negative.

        That of the clip, (B, 2, 2, H, W), is taken to go on as it is.
        """
        first, middle, last = self.flow_times
        return flow[:, 1] * (clocks / (last - middle)) if clocks > 0 else flow[:, 0] * (-clocks / (middle - first))

    def moved(self, state: Tensor, flow: Tensor | None) -> Tensor:
        """Return a neighbour's state, moved by the flow to it, (B, 2, H, W); as it is where nothing moves."""
        if flow is None:
            return state
        picture, memory = self._parted(state)
        rgb = flow_warp(F.pixel_shuffle(picture, self.scale), upsample_flow(flow, self.scale))
        return torch.cat([F.pixel_unshuffle(rgb, self.scale), flow_warp(memory, flow)], dim=1)


def read_from_end(group: Sequence[int], meet: Callable[[int, State | None, State | None], State]) -> Iterator[State]:
    """Yield the states of key frames that know the one behind them, from the last to the first.

    Args:
        group: numbers of the key frames.
        meet: makes the state of a key frame out of those before and behind it, None where there is none.

    Example:
        >>> list(read_from_end("abc", lambda n, before, after: f"({before or ''}{n}{after or ''})"))
        ['(c)', '(b(c))', '(a(b(c)))']
    """
    behind = None
    for n in reversed(group):
        behind = meet(n, None, behind)
        yield behind


def read_forward(
    group: Sequence[int],
    meet: Callable[[int, State | None, State | None], State],
    before: State | None,
    behind: list[State],
) -> Iterator[State]:
    """Yield the states of key frames that know the one before them, and what was read from the end behind them.

    Args:
        group: numbers of the key frames.
        meet: as of :func:`read_from_end`.
        before: state of the key frame before the group, if there is one.
        behind: states of :func:`read_from_end`, from the last to the second, or none; emptied on the way, as states
            are large.

    Example:
        >>> meet = lambda n, before, after: f"({before or ''}{n}{after or ''})"
        >>> list(read_forward("bc", meet, "A", ["(c)"]))
        ['(Ab(c))', '((Ab(c))c)']
    """
    for n in group:
        before = meet(n, before, behind.pop() if behind else None)
        yield before
