"""CSCSR for films, with a recurrent state that passes between key frames."""

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
        fusion_width: channels of the fusion with neighbouring key frames.
        fusion_blocks: residual blocks of the fusion.
        memory: channels of the state in addition to the picture.

    Other fields: see :class:`CSCSRConfig`.

    Raises:
        ValueError: as :class:`CSCSRConfig`; or reconstruction is not correlated, or resolution is not sensor.
    """

    fusion_width: int = 64
    fusion_blocks: int = 3
    memory: int = 32
    size: str = "small"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reconstruction != "correlated" or self.resolution != "sensor":
            expected = "expected correlated and sensor for a recurrent network"
            got = f"{self.reconstruction} and {self.resolution}"
            raise ValueError(f"reconstruction, resolution: {expected}, got {got}")


class StateFusion(nn.Module):
    """Fusion of a clip's picture with the warped states of its neighbours.

    Before training it returns the picture unchanged. Both neighbours share the same weights, so a film can be
    processed in either direction.

    Shape:
        - Input: features :math:`(B, features, H, W)`, the clip's picture :math:`(B, picture, H, W)`, and one or more
          warped states of neighbours, :math:`(B, picture + memory, H, W)`
        - Output: the state of the clip, :math:`(B, picture + memory, H, W)`
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
    r"""CSCSR for films, which fuses each key frame with the warped states of its neighbours.

    The neighbours are the previous key frame, or those on both sides. A single clip gives the same picture as
    :class:`CSCSR` with the same weights. The state of a key frame is its picture, with s x s output pixels per sensor
    pixel as channels, and a memory. The picture is warped at its full resolution, which keeps its fine detail, and
    compared with the picture of the present clip.

    Convention:
        Key frames are ``every`` clocks apart. The flow to a neighbour extrapolates the motion of the key frame's own
        clip, so it needs no further estimate.

    Args:
        *args: fields of :class:`RecurrentCSCSRConfig`, in its order.
        motion: motion estimator, called when no flow is given; see :class:`CSCSR`.
        **settings: fields of :class:`RecurrentCSCSRConfig`, by name.

    Shape:
        - Input: spikes :math:`(B, N, H, W)` of one clip, or :math:`(B, K, N, H, W)` of the clips around K key frames;
          optionally flows, :math:`(B, 2, 2, H, W)` or :math:`(B, K, 2, 2, H, W)`. Values as for :class:`CSCSR`
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
        """Return the picture of a clip (B, N, H, W), or the pictures of a film; other arguments as for :meth:`film`."""
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
        """Return the pictures of a film after each pass over it.

        The film is processed in groups of ``future + 1`` key frames. A group of one uses the state of the previous key
        frame. Larger groups take a backward pass and then a forward pass, so that key frames use both neighbours.

        Args:
            spikes: (B, K, N, H, W).
            flow: (B, K, 2, 2, H, W). Default: estimated from the spikes.
            static: the scene does not move, instead of a flow.
            every: clocks between two key frames.
            future: number of later key frames that a picture may depend on.
            alpha: gain of the camera, a number or (B,). Default: that of the configuration.
            noise: noise level, a number or (B,); see :class:`CSCSR`.

        Returns:
            A list of rgb (B, K, 3, s H, s W): one for ``future=0``, otherwise two, of which the second is better.

        Raises:
            ValueError: ``every`` is not a positive integer, ``future`` is negative, or shapes do not match.
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
        # the fusion must read and write pictures on the new scale
        picture = self.colors * self.scale**2
        self.fusion.neighbor.weight[:, :picture] /= factor
        self.fusion.rest.weight[:picture] *= factor
        self.fusion.rest.bias[:picture] *= factor

    def features(self, spikes: Tensor, flow: Tensor | None, noise: float | Tensor | None = None) -> Tensor:
        """Return the features of a clip, (B, width, H, W); without flow the scene does not move."""
        spikes = spikes.to(self.reconstruction.rgb.weight.dtype)
        told = self._told(noise, spikes)
        return self.reconstruction.features(self._colors(spikes, flow, **told), **told)

    def advance(self, features: Tensor, spikes: Tensor, *neighbors: Tensor) -> Tensor:
        """Return the state of a key frame from its features, its clip, and its neighbours' warped states.

        Returns:
            Picture and memory as channels, (B, 3 s^2 + memory, H, W), or (B, s^2 + memory, H, W) for a grey sensor.
        """
        features = channels_last(features)
        picture = self.reconstruction.rgb(features)
        if self.config.skip:
            picture = picture.add_(self._base(spikes.to(picture.dtype)))
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
        """Extrapolate the flow (B, 2, 2, H, W) of a clip to a time ``clocks`` later, or earlier if negative.

        Returns:
            Flow (B, 2, H, W).
        """
        first, middle, last = self.flow_times
        return flow[:, 1] * (clocks / (last - middle)) if clocks > 0 else flow[:, 0] * (-clocks / (middle - first))

    def moved(self, state: Tensor, flow: Tensor | None) -> Tensor:
        """Warp a neighbour's state along the flow to it, (B, 2, H, W); return it unchanged without flow."""
        if flow is None:
            return state
        picture, memory = self._parted(state)
        rgb = flow_warp(F.pixel_shuffle(picture, self.scale), upsample_flow(flow, self.scale))
        return torch.cat([F.pixel_unshuffle(rgb, self.scale), flow_warp(memory, flow)], dim=1)


def read_from_end(group: Sequence[int], meet: Callable[[int, State | None, State | None], State]) -> Iterator[State]:
    """Yield the states of a backward pass, from the last key frame to the first; each uses the next key frame's state.

    ``meet`` returns the state of a key frame from its index, the state before it and the state after it, or None.

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
    """Yield the states of a forward pass; each uses the previous key frame's state and the next one's backward state.

    The states ``behind``, from the last to the second, are popped from the list in use, to free memory.

    Example:
        >>> meet = lambda n, before, after: f"({before or ''}{n}{after or ''})"
        >>> list(read_forward("bc", meet, "A", ["(c)"]))
        ['(Ab(c))', '((Ab(c))c)']
    """
    for n in group:
        before = meet(n, before, behind.pop() if behind else None)
        yield before
