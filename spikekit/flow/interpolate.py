"""Frame interpolation: the latent frames between two frames of a film."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.check import check_picture, check_planes, check_whole
from spikekit.flow.fields import upsample_flow

# Pixels around a pixel that are compared with it.
_REACH = 2

# How much less a pixel counts per unit of difference between the frames that it connects.
_DISTRUST = 20.0

# Smallest picture, in pixels, that motion is searched in.
_SMALLEST = 16

# A pixel has no counterpart in the other frame where the way there and back does not end near it, and what is found
# there differs by this much. Where this holds for more than half of the pixels, the film was cut.
_DIFFERS = 0.04


class Between:
    """Base of interpolations between two frames, which subclasses define in ``between``.

    Args:
        first: ``rgb`` (3, H, W), floating.
        second: the next frame, in the same size and dtype.

    Attributes:
        first: the frame at 0.
        second: the frame at 1.
        forward: flow (2, H, W) in pixels, order (x, y), from the first to the second frame, where it is known.
        backward: the same from the second to the first.
        cut: the two frames have nothing to do with each other.

    Raises:
        TypeError: not floating-point tensors.
        ValueError: sizes or dtypes that do not fit.
    """

    forward: Tensor | None = None
    backward: Tensor | None = None
    cut: bool = False

    def __init__(self, first: Tensor, second: Tensor) -> None:
        check_picture("first", first)
        check_planes("second", second, 3, "(3, H, W)", floating=True)
        if second.shape != first.shape or second.dtype != first.dtype:
            expected, got = ((tuple(frame.shape), frame.dtype) for frame in (first, second))
            raise ValueError(f"second: expected {expected[0]}, {expected[1]}, got {got[0]}, {got[1]}")
        self.first, self.second = first, second

    def at(self, tau: float) -> Tensor:
        """Return the picture at a time.

        Args:
            tau: 0 is the first frame and 1 the second, both bit for bit.

        Returns:
            ``rgb`` (3, H, W), in the dtype of the frames.

        Raises:
            ValueError: a time outside [0, 1].
        """
        if not 0 <= tau <= 1:
            raise ValueError(f"tau: expected 0 to 1, got {tau}")
        if tau in (0, 1):
            return self.second if tau else self.first
        return self.between(tau)

    def between(self, tau: float) -> Tensor:
        """Return the picture at a time above 0 and below 1."""
        raise NotImplementedError


class _Still(Between):
    def between(self, tau: float) -> Tensor:
        return self.first if tau < 0.5 else self.second


class _Blend(Between):
    def between(self, tau: float) -> Tensor:
        return torch.lerp(self.first, self.second, tau)


class Still:
    """The nearer of the two frames, the second at half way, as a projector shows them.

    Example:
        >>> between = Still()(torch.zeros(3, 4, 4), torch.ones(3, 4, 4))
        >>> [between.at(tau).max().item() for tau in (0, 0.49, 0.5, 1)]
        [0.0, 0.0, 1.0, 1.0]
    """

    def __call__(self, first: Tensor, second: Tensor) -> Between:
        """Look at two frames."""
        return _Still(first, second)


class Blend:
    r"""The mean of the two frames, weighted by time: right where nothing moves and the light changes.

    .. math:: I_\tau = (1 - \tau) I_0 + \tau I_1

    Example:
        >>> Blend()(torch.zeros(3, 4, 4), torch.ones(3, 4, 4)).at(0.25).max().item()
        0.25
    """

    def __call__(self, first: Tensor, second: Tensor) -> Between:
        """Look at two frames."""
        return _Blend(first, second)


class FlowInterpolation:
    r"""Motion-compensated frames from optical flow in both directions, without weights.

    .. math::
        I_\tau(x) = w \, I_0(x - \tau v) + (1 - w) \, I_1(x + (1 - \tau) v), \quad w = 1 - \tau

    where the motion v (x, tau), in pixels per frame, is carried to the time :math:`\tau` by the flows themselves.

    Convention:
        Motion is straight and even between the two frames. Flow in pixels, order (x, y), x right, y down;
        ``forward`` (x) says where the pixel x of the first frame is in the second.

        Flow is estimated once a pair, on luma, by two estimators of scikit-image whose weaknesses differ (TV-L1 and
        iterative Lucas-Kanade); of both, each pixel keeps the one under which its surroundings match better. For every
        time, each frame's flow is splatted to where its pixels are then; among pixels that meet, those that match
        across the frames prevail, so that the foreground covers the background. The three candidates that a pixel
        gets, from both frames and from either one, are told apart by how well the frames match around it. What comes
        from outside of one frame is taken from the other alone. Frames are compared at the same mean brightness and
        sampled bicubically, and the result is kept in the range of the two frames.

        Where more than half of the pixels have no counterpart in the other frame, the film was cut, or motion was too
        large to be followed: ``cut`` is true, there is no flow, and the nearer frame is shown.

        No gradient. Flow is estimated on the CPU, the rest runs where the frames are. On the CPU the same frames give
        the same pictures, bit for bit.

    Args:
        shrink: how many times smaller the pictures are that flow is estimated on. 2 takes a quarter of the time of 1
            and makes the frames of two films as well, within 0.1 dB; small objects in front lose up to 0.8 dB
            (``python benchmarks/interpolation.py``).

    Raises:
        ValueError: ``shrink`` is not a whole number, 1 or more.

    Example:
        >>> from spikekit.scenes.analytic import Layer, Motion, Scene
        >>> y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
        >>> waves = (0.5 + 0.4 * torch.sin(x / 4) * torch.cos(y / 5)).expand(3, 64, 64)
        >>> scene = Scene([Layer(waves, Motion(velocity=(0.2, 0.0)), position=(-16, -16))], 32, 32, frames=21)
        >>> between = FlowInterpolation()(scene.rgb(0), scene.rgb(20))
        >>> error = (between.at(0.5) - scene.rgb(10)).abs().mean().item()
        >>> error < 0.005 < (Blend()(scene.rgb(0), scene.rgb(20)).at(0.5) - scene.rgb(10)).abs().mean().item()
        True

    Reference:
        Baker et al., A database and evaluation methodology for optical flow, IJCV 2011, section 3.3.2.
        Zach, Pock and Bischof, A duality based approach for realtime TV-L1 optical flow, DAGM 2007.
        Le Besnerais and Champagnat, Dense optical flow by iterative local window registration, ICIP 2005.
    """

    def __init__(self, shrink: int = 2) -> None:
        self.shrink = check_whole("shrink", shrink)

    @torch.no_grad()
    def __call__(self, first: Tensor, second: Tensor) -> Between:
        """Estimate the motion between two frames."""
        still = _Still(first, second)
        first, second = first.detach(), second.detach()
        if first.equal(second):
            still.forward = still.backward = torch.zeros_like(first[:2])
            return still
        pair = torch.stack([first, second]).to(torch.promote_types(first.dtype, torch.float32))
        if not pair.isfinite().all():
            raise ValueError("first, second: expected finite pictures, got NaN or Inf")
        light = _light(pair)
        flows = self._flows(pair / light)
        if _lost(pair / light, flows).float().mean() > 0.5:
            still.cut = True
            return still
        return _Carried(first, second, pair / light, light, flows)

    def __repr__(self) -> str:
        return f"FlowInterpolation(shrink={self.shrink})"

    def _flows(self, pair: Tensor) -> Tensor:
        """Return the flows first to second and second to first, (2, 2, H, W)."""
        height, width = pair.shape[-2:]
        small = pair
        if self.shrink > 1:
            padding = (0, -width % self.shrink, 0, -height % self.shrink)
            small = F.avg_pool2d(F.pad(pair, padding, "replicate"), self.shrink)
        candidates = _estimates(_luma(small)).to(pair)
        flows = _best(candidates, _mismatch(small, candidates))
        return upsample_flow(flows, self.shrink)[..., :height, :width]


class _Carried(Between):
    """Frames with their flows, which are carried to any time between them."""

    def __init__(self, first: Tensor, second: Tensor, pair: Tensor, light: Tensor, flows: Tensor) -> None:
        super().__init__(first, second)
        self.forward, self.backward = flows.to(first.dtype)
        self._pair, self._light = pair, light
        match = torch.exp(-_DISTRUST * (pair - _sample(pair.flip(0), flows)).abs().mean(dim=1, keepdim=True))
        # Motion from the first to the second frame as either of them sees it, and how far it can be trusted.
        self._motion = flows * flows.new_tensor([1, -1]).reshape(2, 1, 1, 1)
        self._trust = match + 1e-4

    @torch.no_grad()
    def between(self, tau: float) -> Tensor:
        shares = self._pair.new_tensor([-tau, 1 - tau]).reshape(2, 1, 1, 1)  # of the motion, to the two frames
        candidates = self._candidates(shares)
        seen = torch.stack([_sample(self._pair, shares * motion) for motion in candidates])
        motion = _best(candidates, _around((seen[:, 0] - seen[:, 1]).abs().mean(dim=1)))
        near = shares.flip(0).abs()
        weight = near * torch.where(_inside(shares * motion), 1.0, 1e-6)
        views = _sample(self._pair, shares * motion, "bicubic")
        picture = (weight * views).sum(dim=0) / weight.sum(dim=0) * (near * self._light).sum()
        low, high = (self._pair * self._light).aminmax()
        return picture.clamp(low, high).to(self.first.dtype)

    def _candidates(self, shares: Tensor) -> Tensor:
        """Return what the motion may be at every pixel of the picture at a time, (3, 2, H, W)."""
        carried = _splat(torch.cat([self._motion * self._trust, self._trust], dim=1), -shares * self._motion)
        motion, trust = carried[:, :2], carried[:, 2:]
        nothing = 1e-6  # nothing arrived here
        anywhere = self._motion.mean(dim=0)
        both = torch.where(trust.sum(dim=0) > nothing, motion.sum(dim=0) / (trust.sum(dim=0) + 1e-12), anywhere)
        either = torch.where(trust > nothing, motion / (trust + 1e-12), both)
        return torch.stack([both, *either])


def _light(pair: Tensor) -> Tensor:
    """Return how bright each frame is beside both, (2, 1, 1, 1), so that light that changes is not taken for motion."""
    means = pair.mean(dim=(1, 2, 3), keepdim=True)
    return means / means.mean() if (means > 0).all() else torch.ones_like(means)


def _luma(rgb: Tensor) -> np.ndarray:
    return (rgb * rgb.new_tensor([0.299, 0.587, 0.114]).reshape(3, 1, 1)).sum(dim=-3).float().cpu().numpy()


def _estimates(luma: np.ndarray) -> Tensor:
    """Return what each estimator makes of two pictures (2, H, W): (estimator, direction, 2, H, W)."""
    from skimage.registration import optical_flow_ilk, optical_flow_tvl1

    height, width = luma.shape[-2:]
    padding = [(0, max(0, _SMALLEST - height)), (0, max(0, _SMALLEST - width))]
    pictures = [np.pad(picture, padding, "edge") for picture in luma]

    def both(estimator: object, **settings: object) -> list[np.ndarray]:
        flows = [estimator(*pictures[::step], dtype=np.float32, **settings) for step in (1, -1)]  # type: ignore[operator]
        return [np.ascontiguousarray(flow[::-1, :height, :width]) for flow in flows]  # (row, column) to (x, y)

    return torch.from_numpy(
        np.array([both(optical_flow_tvl1, prefilter=True), both(optical_flow_ilk, radius=4, gaussian=True)])
    )


def _sample(planes: Tensor, flow: Tensor, mode: str = "bilinear") -> Tensor:
    """Sample planes (B, C, H, W) where flow (B, 2, H, W) points to, at the border where it points out."""
    height, width = planes.shape[-2:]
    x, y = _positions(flow)
    grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
    return F.grid_sample(planes, grid, mode, "border", align_corners=False)


def _positions(flow: Tensor) -> tuple[Tensor, Tensor]:
    height, width = flow.shape[-2:]
    x = flow[:, 0] + torch.arange(width, device=flow.device, dtype=flow.dtype)
    y = flow[:, 1] + torch.arange(height, device=flow.device, dtype=flow.dtype)[:, None]
    return x, y


def _inside(flow: Tensor) -> Tensor:
    """Say where flow (B, 2, H, W) ends inside of the picture: (B, 1, H, W)."""
    x, y = _positions(flow)
    height, width = flow.shape[-2:]
    return ((x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5))[:, None]


def _around(error: Tensor) -> Tensor:
    """Average an error (B, H, W) over the surroundings of every pixel."""
    return F.avg_pool2d(F.pad(error, (_REACH,) * 4, "replicate"), 2 * _REACH + 1, 1)


def _mismatch(pair: Tensor, candidates: Tensor) -> Tensor:
    """Say how badly the frames match under each candidate for both flows (K, 2, 2, H, W): (K, 2, H, W)."""
    return torch.stack([_around((pair - _sample(pair.flip(0), flows)).abs().mean(dim=1)) for flows in candidates])


def _best(candidates: Tensor, errors: Tensor) -> Tensor:
    """Choose, pixel by pixel, of candidates (K, *, 2, H, W) the one of the least error (K, *, H, W)."""
    index = errors.argmin(dim=0).unsqueeze(-3)
    return candidates.gather(0, index.unsqueeze(0).expand(1, *candidates.shape[1:]))[0]


def _splat(values: Tensor, flow: Tensor) -> Tensor:
    """Add values (B, C, H, W) up where flow (B, 2, H, W) takes them, spread over the four pixels around."""
    height, width = values.shape[-2:]
    x, y = _positions(flow)
    left, top = x.floor(), y.floor()
    sums = torch.zeros_like(values).flatten(2)
    for i, j in ((left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)):
        inside = (i >= 0) & (i < width) & (j >= 0) & (j < height)
        share = (1 - (x - i).abs()) * (1 - (y - j).abs()) * inside
        index = torch.where(inside, j * width + i, 0).long()
        sums.scatter_add_(2, index.flatten(1)[:, None].expand_as(sums), (values * share[:, None]).flatten(2))
    return sums.view_as(values)


def _lost(pair: Tensor, flows: Tensor) -> Tensor:
    """Say which pixels have no counterpart in the other frame: (2, H, W)."""
    back = _sample(flows.flip(0), flows)
    gap, length = (flows + back).square().sum(dim=1), (flows.square() + back.square()).sum(dim=1)
    return (gap > 0.01 * length + 0.5) & (_mismatch(pair, flows[None])[0] > _DIFFERS)
