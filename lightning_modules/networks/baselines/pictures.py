"""Parts shared by the baselines: decoded pictures, padding, settings, the skip, sub-pixel convolutions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.compiler import is_exporting

from lightning_modules.motion import MotionEstimator
from lightning_modules.networks.layers import conv
from lightning_modules.networks.network import Network
from spikekit import bayer_pattern, demosaic_along_motion, demosaic_residual, linear_motion, tfi_at, tfp_at
from spikekit.check import check_positive, check_whole

Decoder = Literal["tfi", "tfp"]

_TFP_WINDOW = 41  # spike frames that TFP averages


def whole_sizes(**sizes: int) -> dict[str, int]:
    """Return sizes by name, after a check that each is a positive integer."""
    return {name: check_whole(name, size) for name, size in sizes.items()}


def check_decoder(decoder: str) -> None:
    """Check that the decoder is TFI or TFP."""
    if decoder not in ("tfi", "tfp"):
        raise ValueError(f"decoder: expected 'tfi' or 'tfp', got {decoder!r}")


@torch.no_grad()
def decode_pictures(spikes: Tensor, times: Sequence[int], alpha: float, decoder: Decoder = "tfi") -> Tensor:
    """Decode mosaics (B, T, H, W) at T frames of a clip, with white at 1, without gradient."""
    decoded = [tfi_at(spikes, n) if decoder == "tfi" else tfp_at(spikes, n, _TFP_WINDOW) for n in times]
    return torch.stack(decoded, dim=1) / alpha


def mirror_to_multiple(planes: Tensor, multiple: int) -> Tensor:
    """Pad planes (*, H, W) at the bottom and right, until both sides are multiples of a number.

    Padding reflects, without repeating the edge pixel, to keep the Bayer phase; small planes are reflected repeatedly.
    """
    for axis in (-2, -1):
        length = planes.shape[axis]
        whole = (length + multiple - 1) // multiple * multiple
        if is_exporting() or whole > length:  # exported programs accept any length
            at = torch.arange(whole, device=planes.device)
            if not is_exporting():  # exported programs have sides of at least 16, so one reflection suffices
                at %= 2 * length - 2
            planes = planes.index_select(axis, torch.minimum(at, 2 * length - 2 - at))
    return planes


def cut_to(planes: Tensor, height: int, width: int) -> Tensor:
    """Crop planes (*, H, W) to their first rows and columns, to remove the padding."""
    if not is_exporting():
        return planes[..., :height, :width]
    # always copied, as exported programs accept sizes with and without padding
    rows, columns = (torch.arange(length, device=planes.device) for length in (height, width))
    return planes.index_select(-2, rows).index_select(-1, columns)


class Baseline(Network):
    """Base class of the learned baselines, with the settings that all of them share.

    Their flows run between frames 5, 20 and 35 of 41, as for CSCSR.

    Args:
        scale: super-resolution factor s.
        frames: number N of spike frames per clip, odd, at least 9.
        pattern: Bayer phase.
        alpha: gain of the camera: light of a white pixel per clock, in thresholds. The picture is light divided by it.
        motion: motion estimator, called when no flow is given. Default:
            :class:`lightning_modules.motion.ClassicalFlow`.
        more: further settings, of a subclass.
    """

    def __init__(
        self,
        scale: int = 4,
        frames: int = 41,
        pattern: str = "RGGB",
        alpha: float = 0.4,
        *,
        motion: MotionEstimator | None = None,
        more: dict[str, Any],
    ) -> None:
        scale, frames = check_whole("scale", scale), check_whole("frames", frames)
        check_positive("alpha", alpha)
        if frames % 2 == 0 or frames < 9:
            raise ValueError(f"frames: expected an odd number, 9 or more, got {frames}")
        settings = {"scale": scale, "frames": frames, "pattern": bayer_pattern(pattern), "alpha": alpha, **more}
        super().__init__(settings, (frames // 8, frames // 2, frames - 1 - frames // 8), motion)
        self.alpha = alpha

    def flow_or_estimate(self, spikes: Tensor, flow: Tensor | None, static: bool = False) -> Tensor:
        """Return the given flow, the estimated flow, or zeros if ``static``, (B, 2, 2, H, W)."""
        flow = self.resolve_flow(spikes, flow, static)
        return torch.zeros(len(spikes), 2, 2, *spikes.shape[-2:], device=spikes.device) if flow is None else flow

    def offsets(self, flow: Tensor, times: Sequence[int]) -> Tensor:
        """Return the displacement from the middle to each of T times, (B, T, 2, H, W), linear on either side."""
        first, middle, last = self.flow_times
        return linear_motion(flow[:, 0], flow[:, 1], times, first=first, middle=middle, last=last)


@torch.no_grad()
def along_motion(network: Baseline, spikes: Tensor, flow: Tensor) -> Tensor:
    """Return the 3DRI-like picture (B, 3, H, W) of five TFI mosaics, at frames 10, 15, ..., 30 of 41; no gradient."""
    times = [network.frames // 2 + n * (network.frames // 8) for n in range(-2, 3)]
    raw = decode_pictures(spikes, times, network.alpha)
    return demosaic_along_motion(raw, network.offsets(flow, times), network.pattern)


def enlarge_picture(picture: Tensor, scale: int) -> Tensor:
    """Enlarge bicubically, (B, C, H, W) to (B, C, s H, s W)."""
    return picture if scale == 1 else F.interpolate(picture, scale_factor=scale, mode="bicubic", align_corners=False)


def begin_at_zero(*layers: nn.Conv2d) -> None:
    """Initialise convolutions with zeros, so that training starts from the skip connection."""
    for layer in layers:
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)


@torch.no_grad()
def enlarged_raw(raw: Tensor, pattern: str | None, scale: int) -> Tensor:
    """Demosaic (B, H, W) by residual interpolation, unless ``pattern`` is None, and enlarge bicubically."""
    return enlarge_picture(raw.unsqueeze(1) if pattern is None else demosaic_residual(raw, pattern), scale)


def sub_pixel_convolutions(width: int, scale: int, *after: nn.Module) -> nn.Sequential:
    """Return a convolution and a pixel shuffle (Shi et al., CVPR 2016) for each prime factor of the scale.

    Example:
        >>> [layer.upscale_factor for layer in sub_pixel_convolutions(8, 6)[1::2]]
        [2, 3]
    """
    layers: list[nn.Module] = []
    factor = 2
    while scale > 1:
        while scale % factor == 0:
            layers += [conv(width, factor**2 * width), nn.PixelShuffle(factor), *after]
            scale //= factor
        factor += 1
    return nn.Sequential(*layers)
