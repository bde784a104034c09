"""Classical motion estimation: TV-L1 on decoded pictures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from kornia.filters import filter2d_separable, gaussian_blur2d, get_gaussian_kernel1d
from torch import Tensor

from lightning_modules.motion.estimator import MotionEstimator, split_any_size
from spikekit import flow_warp, tfp_at
from spikekit.check import check_planes, check_positive, check_whole
from spikekit.color.cfa import cfa_pattern
from spikekit.flow.tvl1 import tvl1_flow
from spikekit.kernels import compiler_kept_out
from spikekit.sensor.quantization_noise import flicker

_GREY = 0.25, 0.5, 0.25  # each pixel the mean of the Bayer cells that it is part of
_BLUR = tuple(get_gaussian_kernel1d(5, 0.5)[0].tolist())  # of the pictures of a site, in Bayer cells
_ORDER = 3  # of the means that pictures are
_LONGEST = 17  # their window, in frames: in longer clips more of motion blurs them than noise is averaged
_LIGHT = 0.1  # mean firing rate of a clip below which noise harms more, and their window is longer
_NOISE = 0.002  # standard deviation, in firing rates, of a pixel that counts half
_RATES = 1024
_NEAR = 2.0  # around a pixel where it is asked whether motion is linear, in pixels
_PART = 1.25, 1.75  # how many times more different pictures are where flows begin to part, and where they have
_UNSEEN = 1e-6  # squared difference of two pictures that says nothing, in firing rates


class ClassicalFlow(MotionEstimator):
    r"""TV-L1 optical flow on decoded pictures: no weights, any device; on a CPU faster with Numba.

    The clip is decoded in its middle and a quarter of it before and after, by means of third order that see nearly all
    of it, see :func:`spikekit.tfp_at`: noise harms the estimate more than what moves meanwhile. In a clip of at least
    0.1 spikes a frame and pixel they see at most 49 frames; in one with a quarter of that light, twice as many. Motion
    is taken to be linear, so that both flows are those of one velocity, the one that takes the earlier picture to the
    later; from there each half of the clip finds its own, and the flows part where one velocity leaves the pictures
    clearly more different than these two do. The joint flow is estimated on grey pictures of the sensor's size, each
    pixel the mean of the cells that it is part of, so that the noise of the four sites is averaged *before* motion is
    estimated; averaging four flows afterwards, as eq. (7) does with a learned estimator, was less accurate here.

    A dark pixel fires so rarely that a mean flickers. For an ideal sensor its rate tells by how much, and the pixel is
    given less weight accordingly.

    Args:
        attachment: how much the flow follows the pictures, in firing rates, rather than being smooth.
        warps: times that each size of the pictures is gone through. Fewer take less time and are less exact.

    Shape:
        As :class:`MotionEstimator`; no gradient.

    Example:
        >>> to_first, to_last = ClassicalFlow()(torch.ones(1, 41, 16, 16), (5, 20, 35), "RGGB")
        >>> to_first.shape, to_last.abs().max().item()
        (torch.Size([1, 2, 16, 16]), 0.0)

    Reference:
        Zach, Pock and Bischof, A duality based approach for realtime TV-L1 optical flow, DAGM 2007.
    """

    def __init__(self, attachment: float = 120.0, warps: int = 5) -> None:
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
        alike = _clips_by_window(spikes)  # clips that need one window are seen at once
        with torch.autocast(spikes.device.type, enabled=False):
            velocities = [
                self._of_window(spikes if len(alike) == 1 else spikes[clips], middle, window, pattern, by_site)
                for window, clips in alike.items()
            ]
        order = torch.tensor([clip for clips in alike.values() for clip in clips], device=spikes.device).argsort()
        before, after = torch.cat(velocities, dim=-5).index_select(-5, order).unbind(dim=-4)
        return before * (first - middle), after * (last - middle)

    def _of_window(self, spikes: Tensor, middle: int, window: int, pattern: str, by_site: bool) -> Tensor:
        """Velocities before and after the middle, (*, B, 2, 2, h, w), by means of one window."""
        seen, clock = _moments(spikes.shape[1], middle, window)
        raw = torch.stack([tfp_at(spikes, n, window, order=_ORDER, dtype=torch.float32) for n in seen], dim=1)
        rates = (raw.mean(dim=1, keepdim=True) * _RATES).long().clamp(0, _RATES - 1)
        variance = noise_by_rate(window, spikes.device)[rates]
        kernel, border = (_BLUR, "replicate") if by_site else (_GREY, "reflect")
        if by_site:
            raw, variance = (split_any_size(part, pattern).flatten(0, 1) for part in (raw, variance))
        pictures, variance = (
            _filtered(part, weights, border) for part, weights in ((raw, kernel), (variance, [w**2 for w in kernel]))
        )
        attachment = self.attachment / (1 + variance[:, 0] / _NOISE**2)
        velocities = _velocities(pictures, clock, attachment, self.warps)
        return velocities.unflatten(0, (-1, len(spikes))) if by_site else velocities


def _filtered(planes: Tensor, weights: Sequence[float], border: str) -> Tensor:
    kernel = torch.cat([planes.new_full((1, 1), weight) for weight in weights], dim=1)
    return filter2d_separable(planes, kernel, kernel, border)


def _velocities(pictures: Tensor, clock: tuple[float, float, float], attachment: Tensor, warps: int) -> Tensor:
    """Velocities before and after the middle, (B, 2, 2, h, w), in pixels a frame, of pictures (B, 3, h, w)."""
    ends, span = pictures[:, ::2], clock[2] - clock[0]
    before, after = clock[0] - clock[1], clock[2] - clock[1]
    one = tvl1_flow(ends, _times(pictures, before / span, after / span), attachment, warps=warps) / span
    one = one.unsqueeze(1).expand(-1, 2, -1, -1, -1)
    away = _times(pictures[:1], before, after).reshape(2, 1, 1, 1)
    halves = torch.stack([pictures[:, 1:2].expand_as(ends), ends], dim=2).flatten(0, 1)
    start, weight = (one * away).flatten(0, 1), attachment.repeat_interleave(2, dim=0)
    own = tvl1_flow(halves, _times(halves, 0.0, 1.0), weight, start, warps).reshape(one.shape) / away
    unlike, less = (_unlike(pictures, velocities * away) for velocities in (one, own))
    bent = ((unlike / (less + _UNSEEN) - _PART[0]) / (_PART[1] - _PART[0])).clamp(0, 1)
    return torch.lerp(one, own, bent.unsqueeze(1))


def _times(pictures: Tensor, first: float, second: float) -> Tensor:
    """(B, 2), without waiting for a GPU."""
    return torch.stack([pictures.new_full((len(pictures),), time) for time in (first, second)], dim=1)


def _clips_by_window(spikes: Tensor) -> dict[int, list[int]]:
    """Windows of the means of clips (B, N, H, W), in frames, and which clips have each."""
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
    """Frames in which a clip is decoded, and the times that the pictures show.

    Where the mean is cut by the ends of the clip, it stands for a later or an earlier time.
    """
    away = max(frames // 4, 1)
    seen = max(middle - away, 0), middle, min(middle + away, frames - 1)
    clock = torch.arange(frames, dtype=torch.float64, device="cpu").reshape(-1, 1, 1)
    return seen, tuple(tfp_at(clock, n, window, order=_ORDER).item() for n in seen)


@lru_cache(maxsize=16)
def noise_by_rate(window: int, device: torch.device | str = "cpu") -> Tensor:
    """Variance of the mean of a pixel in constant light, by its firing rate, float32."""
    with torch.inference_mode(False), torch.device("cpu"):
        impulses = torch.eye(3 * window, dtype=torch.float64).unsqueeze(1)
        rates = (torch.arange(_RATES) + 0.5) / _RATES
        variance = flicker(tfp_at(impulses, 3 * window // 2, window, order=_ORDER), rates)[0]
    return variance.float().to(device)


def _unlike(pictures: Tensor, flows: Tensor) -> Tensor:
    """Squared difference (B, 1, h, w) of the middle picture from both others where the flows (B, 2, 2, h, w) point."""
    error = flow_warp(pictures[:, ::2].unsqueeze(2), flows).squeeze(2) - pictures[:, 1:2]
    return gaussian_blur2d(error.square().sum(dim=1, keepdim=True), 17, (_NEAR, _NEAR), "replicate")
