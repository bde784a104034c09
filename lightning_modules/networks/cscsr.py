"""CSCSR: colour spike camera super-resolution (Dong et al., CVPR 2024), one module per section of the paper."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from kornia.filters import filter2d_separable
from torch import Tensor, nn

from lightning_modules.motion import MotionEstimator
from lightning_modules.networks.network import Network
from spikekit import bayer_mask, bayer_pattern, demosaic, flow_warp_idw, linear_motion, split_colors, tfp
from spikekit.check import check_planes, check_scale

_SEARCHED = 1 << 19  # positions that are searched in one go


def conv(inputs: int, outputs: int) -> nn.Conv2d:
    """3 x 3 convolution that keeps the size."""
    return nn.Conv2d(inputs, outputs, 3, padding=1)


class ConvBlock(nn.Sequential):
    """3 x 3 convolution and ReLU (Fig. 4)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(conv(inputs, outputs), nn.ReLU(inplace=True))


class ResBlock(nn.Module):
    """Convolution, ReLU, convolution, plus the input: a residual block (He et al., 2016) without normalisation."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(conv(width, width), nn.ReLU(inplace=True), conv(width, width))

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        return x + self.body(x)


class SpikeRepresentation(nn.Module):
    """BSSR of one colour (section 4.2, Fig. 4): features of every time point, from its window and the whole clip.

    Args:
        frames: spike frames N of a clip.
        window: frames that a time point sees.
        stride: frames between two time points.
        width: channels inside.
        features: channels of the result, for every time point.

    Shape:
        - Input: the spikes of one colour, zero elsewhere, :math:`(B, N, H, W)`
        - Output: :math:`(B, T, features, H, W)` with :math:`T = (N - window) / stride + 1`
    """

    def __init__(self, frames: int, window: int, stride: int, width: int, features: int) -> None:
        super().__init__()
        self.window = window
        self.stride = stride
        self.local = nn.Sequential(ConvBlock(window, width), ResBlock(width))
        self.whole = nn.Sequential(ConvBlock(frames, width), ResBlock(width))  # global perception
        self.fuse = nn.Sequential(ConvBlock(2 * width, width), ResBlock(width), conv(width, features))

    def forward(self, spikes: Tensor) -> Tensor:  # noqa: D102
        windows = spikes.unfold(1, self.window, self.stride).movedim(-1, 2)
        batch, times = windows.shape[:2]
        local = self.local(windows.flatten(0, 1))
        whole = self.whole(spikes).repeat_interleave(times, dim=0)
        return self.fuse(torch.cat([local, whole], dim=1)).unflatten(0, (batch, times))


class FeatureRefinement(nn.Module):
    """FR (section 4.3, Fig. 5 c): what deviates from the mean over time is looked at by itself.

    Args:
        times: time points T.
        features: channels of every time point.
        width: channels of the result.

    Shape:
        - Input: temporal-pixel features :math:`(B, T, features, H, W)`
        - Output: :math:`(B, width, H, W)`
    """

    def __init__(self, times: int, features: int, width: int) -> None:
        super().__init__()
        self.base = nn.Sequential(ConvBlock(times * features, width), conv(width, width))
        self.residual = nn.Sequential(ConvBlock(times * features, width), conv(width, width))

    def forward(self, pixels: Tensor) -> Tensor:  # noqa: D102
        residual = pixels - pixels.mean(dim=1, keepdim=True)
        return self.base(pixels.flatten(1, 2)) + self.residual(residual.flatten(1, 2))


class ColorCorrelation(nn.Module):
    """CCR (section 4.4, Fig. 6 a): the colours are refined side by side and fused after every stage.

    Args:
        width: channels, of every colour and inside.
        stages: how often the colours are fused.
        blocks: residual blocks of every colour in every stage.
        end_blocks: residual blocks after the last fusion.

    Shape:
        - Input: features of R, G and B, each :math:`(B, width, H, W)`
        - Output: rgb :math:`(B, 3, H, W)`
    """

    def __init__(self, width: int, stages: int, blocks: int, end_blocks: int) -> None:
        super().__init__()
        self.refine = nn.ModuleList(
            nn.ModuleList(nn.Sequential(*(ResBlock(width) for _ in range(blocks))) for _ in range(3))
            for _ in range(stages)
        )
        # leaky, unlike ConvBlock: everything passes through here, and must not die
        self.fuse = nn.ModuleList(
            nn.Sequential(conv((3 if stage == 0 else 4) * width, width), nn.LeakyReLU(0.1, inplace=True))
            for stage in range(stages)
        )
        self.end = nn.Sequential(*(ResBlock(width) for _ in range(end_blocks)))
        self.rgb = conv(width, 3)

    def forward(self, colors: list[Tensor]) -> Tensor:  # noqa: D102
        fused: list[Tensor] = []
        for refine, fuse in zip(self.refine, self.fuse, strict=True):
            colors = [branch(color) for branch, color in zip(refine, colors, strict=True)]
            fused = [fuse(torch.cat(colors + fused, dim=1))]
        features = fused[0] + self.end(fused[0])
        # half precision would round the picture itself
        with torch.autocast(features.device.type, enabled=False):
            return self.rgb(features.to(self.rgb.weight.dtype))


class CSCSR(Network):
    r"""Super-resolution of a colour picture from a Bayer-pattern spike stream.

    The middle frame of the clip is reconstructed. Widths and depths are not in the paper; the defaults are size M of
    this project, see ``configs/size``.

    Args:
        scale: super-resolution factor s.
        frames: spike frames N of a clip, odd.
        window: spike frames that a time point sees, odd.
        stride: spike frames between two time points; must divide frames - window.
        pattern: Bayer phase of the streams.
        width: channels of refinement and reconstruction, at high resolution.
        representation_width: channels of the spike representation, at sensor resolution.
        features: channels of every time point that are warped.
        stages: fusions of the colours.
        blocks: residual blocks of every colour before every fusion.
        end_blocks: residual blocks after the last fusion.
        skip: learn what to add to a smooth, enlarged TFP picture instead of the picture itself. The paper has no
            such skip; with it training starts where the classical decoder ends.
        alpha: gain of the camera, what a white pixel receives per clock in thresholds; only the skip divides by it.
        neighbors: known pixels that the temporal pixel search weighs.
        motion: estimator that is asked where no flow is given; when not given,
            :class:`lightning_modules.motion.ClassicalFlow`.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, zeros and ones, any real dtype, any H and W of at least 3; optionally
          the flows from the middle to the first and to the last time point, :math:`(B, 2, 2, H, W)`, in sensor pixels
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Example:
        >>> network = CSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
        >>> network(torch.zeros(1, 41, 12, 10), torch.zeros(1, 2, 2, 12, 10)).shape
        torch.Size([1, 3, 24, 20])

    Reference:
        Dong et al., Super-Resolution Reconstruction from Bayer-Pattern Spike Streams, CVPR 2024.
    """

    def __init__(
        self,
        scale: int = 4,
        frames: int = 41,
        window: int = 11,
        stride: int = 3,
        pattern: str = "RGGB",
        width: int = 32,
        representation_width: int = 32,
        features: int = 4,
        stages: int = 3,
        blocks: int = 1,
        end_blocks: int = 3,
        skip: bool = False,
        alpha: float = 0.4,
        neighbors: int = 4,
        motion: MotionEstimator | None = None,
    ) -> None:
        check_scale(scale)
        if frames % 2 == 0 or window % 2 == 0 or not 1 <= window < frames or (frames - window) % stride:
            raise ValueError(
                "frames, window, stride: expected odd frames and window, and a stride that divides frames - window, "
                f"got {frames}, {window}, {stride}"
            )
        if min(width, representation_width, features, stages, blocks, end_blocks, neighbors) < 1:
            raise ValueError("widths, stages, blocks and neighbors: expected 1 or more of each")
        settings = {
            "scale": scale,
            "frames": frames,
            "window": window,
            "stride": stride,
            "pattern": bayer_pattern(pattern),
            "width": width,
            "representation_width": representation_width,
            "features": features,
            "stages": stages,
            "blocks": blocks,
            "end_blocks": end_blocks,
            "skip": skip,
            "alpha": alpha,
            "neighbors": neighbors,
        }
        times = tuple(range(window // 2, frames - window // 2, stride))
        super().__init__(settings, (times[0], frames // 2, times[-1]), motion)
        self.times = times  # centres of the windows, in spike frames
        self.neighbors = neighbors
        self.representation = nn.ModuleList(
            SpikeRepresentation(frames, window, stride, representation_width, features) for _ in range(3)
        )
        self.refinement = nn.ModuleList(FeatureRefinement(len(self.times), features, width) for _ in range(3))
        self.reconstruction = ColorCorrelation(width, stages, blocks, end_blocks)
        self.skip = skip
        self.alpha = alpha
        self._initialize()
        self._masks: dict[Any, Tensor] = {}

    def _initialize(self) -> None:
        """Start nearly pixel by pixel: orthogonal centre taps, small ones around (Xiao et al., ICML 2018).

        A dozen random 3 x 3 filters in a row would blur what the network is to sharpen: training then rests for
        hundreds of steps on a plateau, or dies on it.
        """
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                module.weight.data *= 0.2
                module.weight.data[:, :, 1, 1] += nn.init.orthogonal_(torch.empty(module.weight.shape[:2]), gain=1.2)
                nn.init.zeros_(module.bias)
        for module in self.modules():
            if isinstance(module, ResBlock):
                module.body[-1].weight.data *= 0.1
        if self.skip:
            nn.init.zeros_(self.reconstruction.rgb.weight)

    def forward(self, spikes: Tensor, flow: Tensor | None = None) -> Tensor:  # noqa: D102
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        if spikes.ndim != 4 or spikes.shape[1] != self.frames or min(spikes.shape[-2:]) < 3:
            expected = f"(B, {self.frames}, H, W) of at least 3 x 3 pixels"
            raise ValueError(f"spikes: expected {expected}, got {tuple(spikes.shape)}")
        batch, _, height, width = spikes.shape
        spikes = spikes.to(self.reconstruction.rgb.weight.dtype)
        flow = self.estimate_flow(spikes) if flow is None else flow
        if flow.shape != (batch, 2, 2, height, width):
            raise ValueError(f"flow: expected {(batch, 2, 2, height, width)}, got {tuple(flow.shape)}")
        first, middle, last = self.flow_times
        offsets = linear_motion(
            flow[:, 0], flow[:, 1], self.times, first=first, middle=middle, last=last, scale=self.scale
        )
        colors = [
            refine(self._search(encode(plane), offsets, mask))
            for plane, mask, encode, refine in zip(
                split_colors(spikes, self.pattern),
                self._mask(height, width, spikes.device),
                self.representation,
                self.refinement,
                strict=True,
            )
        ]
        rgb = self.reconstruction(colors)
        return rgb + self._base(spikes) if self.skip else rgb

    def _search(self, features: Tensor, offsets: Tensor, mask: Tensor) -> Tensor:
        """Temporal pixel search (section 4.3, Fig. 5 b): (B, T, C, H, W) to (B, T, C, s H, s W)."""
        # a few time points after the others: what the search needs on the way is many times its result
        few = max(1, _SEARCHED // (offsets.shape[-2] * offsets.shape[-1]))
        pixels = []
        for part, offset in zip(features.flatten(0, 1).split(few), offsets.flatten(0, 1).split(few), strict=True):
            if self.scale > 1:
                part = F.interpolate(part, scale_factor=self.scale, mode="bilinear", align_corners=False)
            pixels.append(flow_warp_idw(part, offset, mask, neighbors=self.neighbors))
        return torch.cat(pixels).unflatten(0, features.shape[:2])

    def _base(self, spikes: Tensor) -> Tensor:
        """TFP of the whole clip, demosaiced, smoothed, enlarged."""
        raw = tfp(spikes, self.frames)[:, self.frames // 2] / self.alpha
        # zero at the Nyquist frequency, where demosaicing leaves a zipper that training would have to undo first
        binomial = raw.new_tensor([[0.25, 0.5, 0.25]])
        smooth = filter2d_separable(demosaic(raw, self.pattern), binomial, binomial)
        if self.scale == 1:
            return smooth
        return F.interpolate(smooth, scale_factor=self.scale, mode="bicubic", align_corners=False)

    def _mask(self, height: int, width: int, device: torch.device) -> tuple[Tensor, ...]:
        key = height, width, device
        if key not in self._masks:
            mask = bayer_mask(height, width, self.pattern, scale=self.scale, device=device, dtype=torch.bool)
            self._masks = {key: mask.unbind(0)}  # the same tensors every time: their tables are kept
        return self._masks[key]
