"""Classical motion estimation: TV-L1 on decoded pictures."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from lightning_modules.motion.estimator import MotionEstimator, split_any_size
from spikekit import flow_warp, tfp_at
from spikekit.check import check_planes, check_positive, check_whole
from spikekit.color.cfa import cfa_pattern
from spikekit.filters import separable_filter
from spikekit.flow.tvl1 import tvl1_flow
from spikekit.kernels import compiler_kept_out
from spikekit.sensor.noise import flicker


def _gaussian(length: int, sigma: float) -> list[float]:
    """Return a normalised kernel, as kornia's, whose import takes a quarter of a second."""
    weights = [math.exp(-((n - length // 2) ** 2) / (2 * sigma**2)) for n in range(length)]
    return [weight / sum(weights) for weight in weights]


_GREY = 0.25, 0.5, 0.25  # kernel that averages the Bayer cells around a pixel
_BLUR = _gaussian(5, 0.5)  # of a sub-stream's pictures, in Bayer cells
_ORDER = 3  # averaging passes of TFP
_LONGEST = 17  # longest TFP window in spike frames, beyond which motion blur outweighs the noise reduction
_LIGHT = 0.1  # mean firing rate of a clip below which the window grows, as noise dominates
_NOISE = 0.002  # standard deviation, in firing rates, that halves the weight of a pixel
_RATES = 1024
_NEAR = _gaussian(17, 2.0)  # window of the test for linear motion
_PART = 1.25, 1.75  # error ratios at which the flows begin to differ, and at which they are independent
_OWN = 2  # warping iterations that refine the velocity of a half, from a joint velocity that is nearly right
_UNSEEN = 1e-6  # negligible squared difference of two pictures, in firing rates


class ClassicalFlow(MotionEstimator):
    r"""TV-L1 optical flow on decoded pictures, without weights; it runs on any device, on a CPU faster with Numba.

    Third-order TFP (:func:`spikekit.tfp_at`) decodes three pictures: at the middle of the clip, and a quarter of its
    length before and after. Their windows cover nearly the whole clip, because noise harms the estimate more than
    motion blur. They span at most 49 spike frames for a firing rate of at least 0.1 spikes per pixel and frame, and
    twice as many for a quarter of that rate.

    Motion is first assumed to be linear, with one velocity from the earlier picture to the later one. Each half of the
    clip then refines its own velocity. The two flows differ only where this reduces the error clearly. The joint flow
    is estimated on grey pictures at the sensor's resolution, each pixel the mean of the Bayer cells around it. This
    averages the noise of the four sub-streams *before* the estimation, which was more accurate than to average four
    flows, as eq. (7) does for a learned estimator.

    Dark pixels fire so rarely that their mean flickers. They get less weight, by the variance that their firing rate
    implies for an ideal sensor.

    Args:
        attachment: weight of the data term for pictures in firing rates; smaller values give smoother flow.
        warps: warping iterations at the finest pyramid level; fewer are faster and less accurate. At most two refine a
            half.

    Shape:
        As :class:`MotionEstimator`; no gradient.

    Example:
        >>> to_first, to_last = ClassicalFlow()(torch.ones(1, 41, 16, 16), (5, 20, 35), "RGGB")
        >>> to_first.shape, to_last.abs().max().item()
        (torch.Size([1, 2, 16, 16]), 0.0)

    Reference:
        Zach, Pock and Bischof, A duality based approach for realtime TV-L1 optical flow, DAGM 2007.
    """

    def __init__(self, attachment: float = 120.0, warps: int = 3) -> None:
        super().__init__()
        check_positive("attachment", attachment)
        self.attachment, self.warps = attachment, check_whole("warps", warps)

    def channel_flows(  # noqa: D102
        self, spikes: Tensor, times: tuple[int, int, int], pattern: str
    ) -> tuple[Tensor, Tensor]:
        return self._flows(spikes, times, pattern, by_site=True)

    def forward(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:  # noqa: D102
        return self._flows(spikes, times, pattern, by_site=False)

    @compiler_kept_out  # Numba compiles its loops
    @torch.no_grad()
    def _flows(self, spikes: Tensor, times: tuple[int, int, int], pattern: str, by_site: bool) -> tuple[Tensor, Tensor]:
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        first, middle, last = times
        if not 0 < middle < spikes.shape[1] - 1 or min(spikes.shape[-2:]) < 2:
            expected = f"(B, N, H, W) of at least 2 x 2 pixels, with frames before and after the middle, {middle}"
            raise ValueError(f"spikes: expected {expected}, got {tuple(spikes.shape)}")
        pattern = cfa_pattern(pattern)
        alike = _clips_by_window(spikes)  # clips with the same window form one batch
        with torch.autocast(spikes.device.type, enabled=False):
            velocities = [
                self._of_window(spikes if len(alike) == 1 else spikes[clips], middle, window, pattern, by_site)
                for window, clips in alike.items()
            ]
        order = torch.tensor([clip for clips in alike.values() for clip in clips], device=spikes.device).argsort()
        before, after = torch.cat(velocities, dim=-5).index_select(-5, order).unbind(dim=-4)
        return before * (first - middle), after * (last - middle)

    def _of_window(self, spikes: Tensor, middle: int, window: int, pattern: str, by_site: bool) -> Tensor:
        """Return the velocities before and after the middle, (*, B, 2, 2, h, w), for one TFP window."""
        seen, clock = _moments(spikes.shape[1], middle, window)
        raw = torch.stack([tfp_at(spikes, n, window, order=_ORDER, dtype=torch.float32) for n in seen], dim=1)
        rates = (raw.mean(dim=1, keepdim=True) * _RATES).long().clamp(0, _RATES - 1)
        variance = noise_by_rate(window, spikes.device)[rates]
        kernel, border = (_BLUR, "replicate") if by_site else (_GREY, "reflect")
        if by_site:
            raw, variance = (split_any_size(part, pattern).flatten(0, 1) for part in (raw, variance))
        pictures, variance = (
            separable_filter(part, weights, border)
            for part, weights in ((raw, kernel), (variance, [w**2 for w in kernel]))
        )
        attachment = self.attachment / (1 + variance[:, 0] / _NOISE**2)
        velocities = self._velocities(pictures, clock, attachment)
        return velocities.unflatten(0, (-1, len(spikes))) if by_site else velocities

    def _velocities(self, pictures: Tensor, clock: tuple[float, float, float], attachment: Tensor) -> Tensor:
        """Return the velocities before and after the middle, (B, 2, 2, h, w), in pixels per clock."""
        ends, span = pictures[:, ::2], clock[2] - clock[0]
        before, after = clock[0] - clock[1], clock[2] - clock[1]
        one = tvl1_flow(ends, _times(pictures, before / span, after / span), attachment, warps=self.warps) / span
        one = one.unsqueeze(1).expand(-1, 2, -1, -1, -1)
        away = _times(pictures[:1], before, after).reshape(2, 1, 1, 1)
        halves = torch.stack([pictures[:, 1:2].expand_as(ends), ends], dim=2).flatten(0, 1)
        start, weight = (one * away).flatten(0, 1), attachment.repeat_interleave(2, dim=0)
        own = tvl1_flow(halves, _times(halves, 0.0, 1.0), weight, start, min(self.warps, _OWN))
        own = own.reshape(one.shape) / away
        unlike, less = (_unlike(pictures, velocities * away) for velocities in (one, own))
        bent = ((unlike / (less + _UNSEEN) - _PART[0]) / (_PART[1] - _PART[0])).clamp(0, 1)
        return torch.lerp(one, own, bent.unsqueeze(1))


def _times(pictures: Tensor, first: float, second: float) -> Tensor:
    """Return two times for each clip, (B, 2), without synchronising with a GPU."""
    return torch.stack([pictures.new_full((len(pictures),), time) for time in (first, second)], dim=1)


def _clips_by_window(spikes: Tensor) -> dict[int, list[int]]:
    """Group clips (B, N, H, W) by their TFP window in spike frames."""
    frames, found = spikes.shape[1], {}
    wide = torch.float32 if spikes.is_floating_point() else None
    for clip, fired in enumerate(spikes.flatten(1).sum(dim=1, dtype=wide).cpu().tolist()):
        rate = max(fired, 1) / spikes[0].numel()
        longest = _LONGEST * max((_LIGHT / rate) ** 0.5, 1)
        window = 2 * max(int(min((frames - 1) // 6, longest / 2)), 1) + 1
        found.setdefault(window, []).append(clip)
    return found


@lru_cache(maxsize=16)
def _moments(frames: int, middle: int, window: int) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return the frames at which a clip is decoded, and the effective times of the pictures.

    The two differ where the ends of the clip truncate the window.
    """
    away = max(frames // 4, 1)
    seen = max(middle - away, 0), middle, min(middle + away, frames - 1)
    clock = torch.arange(frames, dtype=torch.float64, device="cpu").reshape(-1, 1, 1)
    return seen, tuple(tfp_at(clock, n, window, order=_ORDER).item() for n in seen)


@lru_cache(maxsize=16)
def noise_by_rate(window: int, device: torch.device | str = "cpu") -> Tensor:
    """Return the variance of a pixel's TFP in constant light, as a float32 table over its firing rate."""
    with torch.inference_mode(False), torch.device("cpu"):
        impulses = torch.eye(3 * window, dtype=torch.float64).unsqueeze(1)
        rates = (torch.arange(_RATES) + 0.5) / _RATES
        variance = flicker(tfp_at(impulses, 3 * window // 2, window, order=_ORDER), rates)[0]
    return variance.float().to(device)


def _unlike(pictures: Tensor, flows: Tensor) -> Tensor:
    """Return the squared error (B, 1, h, w) between the middle picture and both others, warped by their flows."""
    error = flow_warp(pictures[:, ::2].unsqueeze(2), flows).squeeze(2) - pictures[:, 1:2]
    return separable_filter(error.square().sum(dim=1, keepdim=True), _NEAR, "replicate")
