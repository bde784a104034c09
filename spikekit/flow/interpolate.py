"""Frame interpolation: latent frames between two frames of a film."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spikekit.check import check_picture, check_planes, check_whole
from spikekit.flow.fields import ends, ends_inside, upsample_flow

# Radius, in pixels, of the window in which frames are compared.
_REACH = 2

# Decay of a pixel's weight per unit of difference between the frames.
_DISTRUST = 20.0

# Smallest side, in pixels, for flow estimation; smaller pictures are padded.
_SMALLEST = 16

# A pixel has no counterpart in the other frame if forward and backward flow disagree and the frames differ by more than
# this. If this holds for more than half of the pixels, there is a cut.
_DIFFERS = 0.04


class Between:
    """Interpolation between two frames: the nearest of them, unless a subclass implements ``between``.

    Args:
        first: ``rgb`` (3, H, W), floating.
        second: the next frame, in the same size and dtype.

    Attributes:
        first: the frame at time 0.
        second: the frame at time 1.
        forward: flow (2, H, W) in pixels, order (x, y), from the first to the second frame, or ``None``.
        backward: flow from the second to the first frame, or ``None``.
        cut: whether there is a cut between the frames.

    Raises:
        TypeError: a frame is not a floating-point tensor.
        ValueError: the frames differ in size or dtype.
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
        """Return the picture at time ``tau``.

        Args:
            tau: time in [0, 1]; 0 returns the first frame and 1 the second, bit for bit.

        Returns:
            ``rgb`` (3, H, W), in the dtype of the frames.

        Raises:
            ValueError: ``tau`` is outside [0, 1].
        """
        if not 0 <= tau <= 1:
            raise ValueError(f"tau: expected 0 to 1, got {tau}")
        if tau in (0, 1):
            return self.second if tau else self.first
        return self.between(tau)

    def between(self, tau: float) -> Tensor:
        """Return the picture at a time strictly between 0 and 1."""
        return self.first if tau < 0.5 else self.second


class _Blend(Between):
    def between(self, tau: float) -> Tensor:
        return torch.lerp(self.first, self.second, tau)


class Still:
    """Nearest frame: the first before half way, the second from there on.

    Example:
        >>> between = Still()(torch.zeros(3, 4, 4), torch.ones(3, 4, 4))
        >>> [between.at(tau).max().item() for tau in (0, 0.49, 0.5, 1)]
        [0.0, 0.0, 1.0, 1.0]
    """

    def __call__(self, first: Tensor, second: Tensor) -> Between:
        """Return the interpolation between two frames."""
        return Between(first, second)


class Blend:
    r"""Mean of the two frames, weighted by time: exact for still scenes with changing light.

    .. math:: I_\tau = (1 - \tau) I_0 + \tau I_1

    Example:
        >>> Blend()(torch.zeros(3, 4, 4), torch.ones(3, 4, 4)).at(0.25).max().item()
        0.25
    """

    def __call__(self, first: Tensor, second: Tensor) -> Between:
        """Return the interpolation between two frames."""
        return _Blend(first, second)


class FlowInterpolation:
    r"""Motion-compensated frames from optical flow in both directions, without learned weights.

    .. math::
        I_\tau(x) = w \, I_0(x - \tau v) + (1 - w) \, I_1(x + (1 - \tau) v), \quad w = 1 - \tau

    where the motion v (x, tau), in pixels per frame, is obtained by splatting the flows to the time :math:`\tau`.

    Convention:
        Motion between the two frames is assumed to be linear. Flow in pixels, order (x, y), x right, y down; pixel x of
        the first frame is at x + ``forward`` (x) in the second.

        Flow is estimated once per pair, on luma, by two estimators of scikit-image with different weaknesses (TV-L1 and
        iterative Lucas-Kanade); each pixel keeps the flow under which its neighbourhood matches better. For every time,
        the flow of each frame is splatted to the positions of its pixels at that time. Pixels that match across the
        frames get larger weights there, so that the foreground covers the background. Every pixel has three candidates,
        from both frames and from each one, and keeps the one under which the frames match best around it. Content from
        outside one frame is taken from the other. Frames are compared at the same mean brightness and sampled
        bicubically, and the result is clamped to the range of the two frames.

        If more than half of the pixels have no counterpart in the other frame, there is a cut, or motion is too large:
        ``cut`` is true, there is no flow, and the result is the nearest frame.

        No gradient. Flow is estimated on the CPU; the rest runs on the device of the frames. On the CPU, results are
        reproducible bit for bit.

    Args:
        shrink: factor by which pictures are reduced for flow estimation. 2 takes a quarter of the time of 1. The frames
            of two films are as good, within 0.1 dB; small objects in front lose up to 0.8 dB
            (``python benchmarks/interpolation.py``).

    Raises:
        ValueError: ``shrink`` is not a whole number >= 1.

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
        still = Between(first, second)
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
        luma = (small * small.new_tensor([0.299, 0.587, 0.114]).reshape(3, 1, 1)).sum(dim=-3)
        candidates = _estimates(luma.float().cpu().numpy()).to(pair)
        flows = _best(candidates, _mismatch(small, candidates))
        return upsample_flow(flows, self.shrink)[..., :height, :width]


class _Carried(Between):
    """Interpolation of two frames by their flows."""

    def __init__(self, first: Tensor, second: Tensor, pair: Tensor, light: Tensor, flows: Tensor) -> None:
        super().__init__(first, second)
        self.forward, self.backward = flows.to(first.dtype)
        self._pair, self._light = pair, light
        match = torch.exp(-_DISTRUST * (pair - _sample(pair.flip(0), flows)).abs().mean(dim=1, keepdim=True))
        # Motion from the first to the second frame, estimated from each, and its weight.
        self._motion = flows * flows.new_tensor([1, -1]).reshape(2, 1, 1, 1)
        self._trust = match + 1e-4

    @torch.no_grad()
    def between(self, tau: float) -> Tensor:
        shares = self._pair.new_tensor([-tau, 1 - tau]).reshape(2, 1, 1, 1)  # of the motion, to the two frames
        candidates = self._candidates(shares)
        seen = torch.stack([_sample(self._pair, shares * motion) for motion in candidates])
        motion = _best(candidates, _around((seen[:, 0] - seen[:, 1]).abs().mean(dim=1)))
        near = shares.flip(0).abs()
        weight = near * torch.where(ends_inside(shares * motion, beyond=0.5)[:, None], 1.0, 1e-6)
        views = _sample(self._pair, shares * motion, "bicubic")
        picture = (weight * views).sum(dim=0) / weight.sum(dim=0) * (near * self._light).sum()
        low, high = (self._pair * self._light).aminmax()
        return picture.clamp(low, high).to(self.first.dtype)

    def _candidates(self, shares: Tensor) -> Tensor:
        """Return the candidates for the motion at every pixel of a picture, (3, 2, H, W)."""
        carried = _splat(torch.cat([self._motion * self._trust, self._trust], dim=1), -shares * self._motion)
        motion, trust = carried[:, :2], carried[:, 2:]
        nothing = 1e-6  # total weight below which nothing was splatted
        anywhere = self._motion.mean(dim=0)
        both = torch.where(trust.sum(dim=0) > nothing, motion.sum(dim=0) / (trust.sum(dim=0) + 1e-12), anywhere)
        either = torch.where(trust > nothing, motion / (trust + 1e-12), both)
        return torch.stack([both, *either])


def _light(pair: Tensor) -> Tensor:
    """Return the relative brightness of the frames, (2, 1, 1, 1), to separate changing light from motion."""
    means = pair.mean(dim=(1, 2, 3), keepdim=True)
    return means / means.mean() if (means > 0).all() else torch.ones_like(means)


def _estimates(luma: np.ndarray) -> Tensor:
    """Return the flow of two pictures (2, H, W) by each estimator: (estimator, direction, 2, H, W)."""
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
    """Warp planes (B, C, H, W) by flow (B, 2, H, W), with replicated borders."""
    height, width = planes.shape[-2:]
    x, y = ends(flow)
    grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
    return F.grid_sample(planes, grid, mode, "border", align_corners=False)


def _around(error: Tensor) -> Tensor:
    """Average an error (B, H, W) over the window around every pixel."""
    return F.avg_pool2d(F.pad(error, (_REACH,) * 4, "replicate"), 2 * _REACH + 1, 1)


def _mismatch(pair: Tensor, candidates: Tensor) -> Tensor:
    """Return the mismatch (K, 2, H, W) of the frames under each candidate for both flows, (K, 2, 2, H, W)."""
    return torch.stack([_around((pair - _sample(pair.flip(0), flows)).abs().mean(dim=1)) for flows in candidates])


def _best(candidates: Tensor, errors: Tensor) -> Tensor:
    """Choose at every pixel the candidate (K, *, 2, H, W) with the smallest error (K, *, H, W)."""
    index = errors.argmin(dim=0).unsqueeze(-3)
    return candidates.gather(0, index.unsqueeze(0).expand(1, *candidates.shape[1:]))[0]


def _splat(values: Tensor, flow: Tensor) -> Tensor:
    """Splat values (B, C, H, W) along flow (B, 2, H, W), bilinearly, and sum them."""
    height, width = values.shape[-2:]
    x, y = ends(flow)
    left, top = x.floor(), y.floor()
    sums = torch.zeros_like(values).flatten(2)
    for i, j in ((left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)):
        inside = (i >= 0) & (i < width) & (j >= 0) & (j < height)
        share = (1 - (x - i).abs()) * (1 - (y - j).abs()) * inside
        index = torch.where(inside, j * width + i, 0).long()
        sums.scatter_add_(2, index.flatten(1)[:, None].expand_as(sums), (values * share[:, None]).flatten(2))
    return sums.view_as(values)


def _lost(pair: Tensor, flows: Tensor) -> Tensor:
    """Return a mask (2, H, W) of the pixels without a counterpart in the other frame."""
    back = _sample(flows.flip(0), flows)
    gap, length = (flows + back).square().sum(dim=1), (flows.square() + back.square()).sum(dim=1)
    return (gap > 0.01 * length + 0.5) & (_mismatch(pair, flows[None])[0] > _DIFFERS)
