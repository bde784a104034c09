"""Parts shared by the baselines: decoded pictures, padding, settings, the skip, sub-streams, convolutions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.compiler import is_exporting

from lightning_modules.motion import MotionEstimator
from lightning_modules.motion.estimator import split_any_size
from lightning_modules.networks.layers import conv
from lightning_modules.networks.network import Network
from spikekit import bayer_pattern, demosaic_along_motion, demosaic_residual, flow_warp, linear_motion, tfi_at, tfp_at
from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import bayer_sites

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


def run_per_channel(
    reconstruct: Callable[[Tensor, Tensor], Tensor], spikes: Tensor, flow: Tensor, pattern: str, scale: int
) -> Tensor:
    r"""Reconstruct each Bayer sub-stream separately with one shared single-channel network, and merge the colours.

    The paper only says that VidarSR\* and SpikeSR-Net\* handle "each color channel separately". Here the four
    sub-streams, each half the size of the sensor, are enlarged by 2 s and shifted bilinearly by half a sensor pixel,
    the distance of their pixels from the centre of the Bayer cell. The two greens are averaged.

    ``reconstruct`` maps the spikes of sub-streams, (4 B, N, h, w), and their flows, (4 B, 2, 2, h, w), in pixels of
    the sub-streams, to pictures (4 B, 1, 2 s h, 2 s w). The result is rgb (B, 3, s H, s W).
    """
    batch, (height, width) = len(spikes), spikes.shape[-2:]
    planes = split_any_size(spikes, pattern)
    flows = split_any_size(flow.flatten(1, 2), pattern).unflatten(2, (2, 2)) / 2
    pictures = reconstruct(planes.flatten(0, 1), flows.flatten(0, 1)).unflatten(0, (4, batch))
    colors: list[list[Tensor]] = [[], [], []]
    for picture, (color, row, column) in zip(pictures, bayer_sites(pattern), strict=True):
        # the value at (x, y) is at (x, y) + shift in the sub-stream's picture
        shift = picture.new_tensor([scale / 2 - scale * column, scale / 2 - scale * row]).reshape(1, 2, 1, 1)
        colors[color].append(flow_warp(picture, shift.expand(batch, 2, *picture.shape[-2:])))
    rgb = torch.cat([torch.stack(found).mean(dim=0) for found in colors], dim=1)
    return rgb[..., : scale * height, : scale * width]


class DeformableConv2d(nn.Module):
    r"""Modulated deformable 3 x 3 convolution; a convolution predicts its offsets and masks from guide features.

    The predictor is initialised with zeros: no offset, and all masks 0.5. Positions are computed in the precision of
    the weights, also under autocast. Each of the ``groups`` of channels has its own offsets.

    Shape:
        - Input: features and guide, each :math:`(B, C, H, W)`
        - Output: :math:`(B, C, H, W)`

    Example:
        >>> DeformableConv2d(8, groups=2)(torch.rand(1, 8, 5, 6), torch.rand(1, 8, 5, 6)).shape
        torch.Size([1, 8, 5, 6])

    Reference:
        Zhu et al., Deformable ConvNets v2, CVPR 2019.
    """

    def __init__(self, width: int, groups: int = 8) -> None:
        super().__init__()
        if width % groups:
            raise ValueError(f"width: expected a multiple of {groups}, the groups of offsets, got {width}")
        self.where = conv(width, 27 * groups)
        begin_at_zero(self.where)
        taps = conv(width, width)
        self.weight, self.bias = taps.weight, taps.bias

    def forward(self, features: Tensor, guide: Tensor) -> Tensor:  # noqa: D102
        from kornia.feature.aliked.deform_conv2d import deform_conv2d

        where = self.where(guide).to(self.weight.dtype)
        offsets, masks = where.split([where.shape[1] * 2 // 3, where.shape[1] // 3], dim=1)
        with torch.autocast(features.device.type, enabled=False):
            features = features.to(self.weight.dtype)
            return deform_conv2d(features, offsets, self.weight, self.bias, padding=1, mask=masks.sigmoid())
