"""Motion without weights: TV-L1, on decoded pictures."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightning_modules.motion.estimator import MotionEstimator, split_any_size
from spikekit import flow_warp, tfp_at
from spikekit.check import check_planes

_BLUR = 0.5  # of the pictures of a site, in Bayer cells
_NEAR = 2.0  # around a pixel where it is asked whether motion is linear, in pixels
_PART = 1.25, 1.75  # how many times more different pictures are where flows begin to part, and where they have
_UNSEEN = 1e-6  # squared difference of two pictures that says nothing, in firing rates


class ClassicalFlow(MotionEstimator):
    r"""TV-L1 optical flow (scikit-image) on decoded pictures: no weights, runs on the CPU.

    The clip is decoded in its middle and a quarter of it before and after, by means of third order that see nearly all
    of it, see :func:`spikekit.tfp_at`: noise harms the estimate more than what moves meanwhile. Motion is taken to be
    linear, so that both flows are those of one velocity, the mean of what the earlier and the later picture tell; they
    part where that leaves the pictures clearly more different than a velocity each does. The joint flow is estimated
    on grey pictures of the sensor's size, each pixel the mean of the cells that it is part of, so that the noise of the
    four sites is averaged *before* motion is estimated; averaging four flows afterwards, as eq. (7) does with a learned
    estimator, was less accurate here. Of scikit-image's two estimators this one keeps the edges of motion; kornia has
    no dense flow estimator without weights.

    Args:
        attachment: how much the flow follows the pictures rather than being smooth. It is weighed against firing rates,
            so that the noise of a dark scene counts for as little as it is.
        tolerance: root mean square, in pixels, of a change of the flow after which a level of the pyramid is done; a
            scene that moves little costs little. Levels are warped five times at most, and that often with 0.

    Shape:
        As :class:`MotionEstimator`; no gradient.

    Example:
        >>> to_first, to_last = ClassicalFlow()(torch.ones(1, 41, 16, 16), (5, 20, 35), "RGGB")
        >>> to_first.shape, to_last.abs().max().item()
        (torch.Size([1, 2, 16, 16]), 0.0)

    Reference:
        Zach, Pock and Bischof, A duality based approach for realtime TV-L1 optical flow, DAGM 2007.
    """

    def __init__(self, attachment: float = 30.0, tolerance: float = 0.1) -> None:
        super().__init__()
        if not 0 < attachment < math.inf:
            raise ValueError(f"attachment: expected a positive number, got {attachment}")
        if not 0 <= tolerance < math.inf:
            raise ValueError(f"tolerance: expected 0 or more pixels, got {tolerance}")
        self.attachment, self.tolerance = attachment, tolerance

    @torch.compiler.disable(reason="scikit-image is not for a compiler")
    @torch.no_grad()
    def channel_flows(  # noqa: D102
        self, spikes: Tensor, times: tuple[int, int, int], pattern: str
    ) -> tuple[Tensor, Tensor]:
        from skimage.filters import gaussian

        raw, clock = _decode(spikes, times[1])
        sites = split_any_size(raw, pattern)
        blurred = gaussian(sites.cpu().numpy(), (0, 0, 0, _BLUR, _BLUR), mode="nearest")
        before, after = torch.stack([self._velocities(pictures, clock) for pictures in blurred], dim=1).to(raw)
        return before * (times[0] - times[1]), after * (times[2] - times[1])

    @torch.compiler.disable(reason="scikit-image is not for a compiler")
    @torch.no_grad()
    def forward(self, spikes: Tensor, times: tuple[int, int, int], pattern: str) -> tuple[Tensor, Tensor]:  # noqa: D102
        raw, clock = _decode(spikes, times[1])
        grey = F.avg_pool2d(F.avg_pool2d(F.pad(raw, (1, 1, 1, 1), "reflect"), 2, 1), 2, 1)
        before, after = self._velocities(grey.cpu().numpy(), clock).to(raw)
        return before * (times[0] - times[1]), after * (times[2] - times[1])

    def _velocities(self, pictures: np.ndarray, clock: list[float]) -> Tensor:
        """Velocities before and after the middle, (2, B, 2, h, w), in pixels a frame, of pictures (B, 3, h, w)."""
        from skimage.registration import optical_flow_tvl1

        away = clock[0] - clock[1], clock[2] - clock[1]
        found = []
        for clip in pictures:
            flows = [
                optical_flow_tvl1(clip[1], other, attachment=self.attachment, tol=self.tolerance**2, dtype=np.float32)
                for other in (clip[0], clip[2])
            ]
            own = np.stack([flow[::-1] / frames for flow, frames in zip(flows, away, strict=True)])
            one = own.mean(axis=0, keepdims=True)
            bent = np.interp(_unlike(clip, one, away) / (_unlike(clip, own, away) + _UNSEEN), _PART, (0, 1))
            found.append(one + bent.astype(np.float32) * (own - one))
        return torch.from_numpy(np.stack(found, axis=1))

    def extra_repr(self) -> str:  # noqa: D102
        return f"attachment={self.attachment}, tolerance={self.tolerance}"


def _decode(spikes: Tensor, middle: int) -> tuple[Tensor, list[float]]:
    """Three raw pictures (B, 3, H, W), and the times that they show."""
    check_planes("spikes", spikes, 4, "(B, N, H, W)")
    frames = spikes.shape[1]
    window, away = 2 * max((frames - 1) // 6, 1) + 1, max(frames // 4, 1)
    seen = [max(middle - away, 0), middle, min(middle + away, frames - 1)]
    raw = torch.stack([tfp_at(spikes, n, window, order=3, dtype=torch.float32) for n in seen], dim=1)
    # where the mean is cut by the ends of the clip, it stands for a later or an earlier time
    clock = torch.arange(frames, dtype=torch.float64).reshape(-1, 1, 1)
    return raw, [tfp_at(clock, n, window, order=3).item() for n in seen]


def _unlike(clip: np.ndarray, velocities: np.ndarray, away: tuple[float, float]) -> np.ndarray:
    """Squared difference (h, w) of the middle picture from both others where these velocities see them."""
    from skimage.filters import gaussian

    others = torch.from_numpy(clip[::2, None])
    flows = torch.from_numpy(velocities) * others.new_tensor(away).reshape(2, 1, 1, 1)
    error = (flow_warp(others, flows).numpy() - clip[1]) ** 2
    return gaussian(error.sum(axis=(0, 1)), _NEAR, mode="nearest")
