"""CSCSR: colour spike camera super-resolution (Dong et al., CVPR 2024), its parts put together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

import torch
import torch.nn.functional as F
from kornia.filters import filter2d_separable
from torch import Tensor, nn

from lightning_modules.motion import MotionEstimator, ZeroFlow
from lightning_modules.networks.layers import ResBlock, enlarge, fold
from lightning_modules.networks.motion_fusion import assembled_motion, independent_motion, joint_motion
from lightning_modules.networks.network import Network
from lightning_modules.networks.reconstruction import ColorCorrelation, EarlyFusion, SeparateColors
from lightning_modules.networks.refinement import FeatureRefinement, TimeFusion
from lightning_modules.networks.representation import IntervalRepresentation, SpikeRepresentation, WindowMeans
from lightning_modules.networks.rest import WORTH_IT, convolve_at_rest, rest_response
from spikekit import bayer_mask, bayer_pattern, demosaic, flow_warp_idw, linear_motion, split_colors, tfp_at
from spikekit.check import check_planes, check_positive, check_whole

_SEARCHED = 1 << 19  # positions that are searched in one go

T = TypeVar("T")

_MOTION_FUSIONS = {"joint": joint_motion, "independent": independent_motion, "assembled": assembled_motion}
_RECONSTRUCTIONS = {"correlated": ColorCorrelation, "separate": SeparateColors, "early": EarlyFusion}


def _choose(name: str, value: str, choices: Mapping[str, T]) -> T:
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
    return choices[value]


class CSCSR(Network):
    r"""Super-resolution of a colour picture from a Bayer-pattern spike stream.

    The middle frame of the clip is reconstructed. Widths and depths are not in the paper; the defaults are size M of
    this project, see ``configs/size``. The arguments from ``representation`` to ``reconstruction`` are the ablations
    of the paper's Table 3, see ``configs/ablation``; the defaults are the full network (J).

    Args:
        scale: super-resolution factor s.
        frames: spike frames N of a clip, odd.
        window: spike frames that a time point sees, odd.
        stride: spike frames between two time points; must divide frames - window.
        pattern: Bayer phase of the streams.
        width: channels of refinement and reconstruction.
        representation_width: channels of the spike representation, at sensor resolution.
        features: channels of every time point that are warped.
        stages: fusions of the colours.
        blocks: residual blocks of every colour before every fusion.
        end_blocks: residual blocks after the last fusion.
        end_width: channels after the last fusion; when not given, ``width``.
        skip: learn what to add to a smooth, enlarged TFP picture instead of the picture itself. The paper has no
            such skip; with it training starts where the classical decoder ends.
        alpha: gain of the camera, what a white pixel receives per clock in thresholds; only the skip divides by it.
        neighbors: known pixels that the temporal pixel search weighs.
        steps: positions per pixel of the picture, along each axis, that the search rounds motion to, an even number,
            which makes it faster on a CPU; 0 for the exact search. Weights serve with any.
        motion: estimator that is asked where no flow is given; when not given,
            :class:`lightning_modules.motion.ClassicalFlow`.
        representation: features of a time point: ``"bssr"`` learns them; ``"spikes"``, without BSSR (A), averages the
            spikes of the window; ``"interval"`` (C) takes the inverse of the spike interval. These two have no weights
            and one feature.
        global_perception: BSSR sees the whole clip beside the window; False is B.
        motion_fusion: where no flow is given, ``"joint"`` moves all colours alike; ``"independent"`` (D) moves each
            by the flow of its own sub-stream, green by the mean of its two; ``"assembled"`` (E) puts the sub-streams'
            flows together as their pixels are in the Bayer pattern.
        search: temporal pixel search along the motion. Without it no motion is estimated, a given one is ignored, and
            the features of every time point are only enlarged; without refinement as well it is F, no MSR.
        refinement: FR; False is G, which merges the time points by one convolution.
        reconstruction: ``"correlated"`` is CCR; ``"separate"`` (H) lets every colour make its channel by itself;
            ``"early"`` (I) fuses the colours once, at the beginning.
        resolution: where refinement and reconstruction work. ``"output"`` is that of the picture, as in the paper;
            ``"sensor"`` that of the sensor, with the s x s temporal pixels of a site as channels and a sub-pixel
            convolution at the end: the same width then costs 1 / s^2 of the work.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, zeros and ones, any real dtype, any H and W of at least 3; optionally
          the flows from the middle to the first and to the last time point, :math:`(B, 2, 2, H, W)`, in sensor
          pixels, or those of R, G and B, :math:`(B, 3, 2, 2, H, W)`, or 0 where nothing moves: what flows of zeros
          give, in less time
        - Output: rgb :math:`(B, 3, s H, s W)`, not clamped

    Raises:
        ValueError: sizes that do not fit each other, an unknown choice, or choices that would have no effect:
            ``global_perception=False`` without BSSR, a ``motion_fusion`` without search, an ``end_width`` of separate
            colours.

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
        end_width: int | None = None,
        skip: bool = False,
        alpha: float = 0.4,
        neighbors: int = 4,
        steps: int = 16,
        motion: MotionEstimator | None = None,
        representation: Literal["bssr", "spikes", "interval"] = "bssr",
        global_perception: bool = True,
        motion_fusion: Literal["joint", "independent", "assembled"] = "joint",
        search: bool = True,
        refinement: bool = True,
        reconstruction: Literal["correlated", "separate", "early"] = "correlated",
        resolution: Literal["output", "sensor"] = "output",
    ) -> None:
        sizes = {
            "scale": scale,
            "frames": frames,
            "window": window,
            "stride": stride,
            "width": width,
            "representation_width": representation_width,
            "features": features,
            "stages": stages,
            "blocks": blocks,
            "end_blocks": end_blocks,
            "neighbors": neighbors,
        }
        sizes = {name: check_whole(name, size) for name, size in sizes.items()}
        check_positive("alpha", alpha)
        if frames % 2 == 0 or window % 2 == 0 or window >= frames or (frames - window) % stride:
            raise ValueError(
                "frames, window, stride: expected odd frames and window, and a stride that divides frames - window, "
                f"got {frames}, {window}, {stride}"
            )
        if end_width is not None:
            end_width = check_whole("end_width", end_width)
        if steps < 0 or steps % 2:
            raise ValueError(f"steps: expected an even number, or 0 for the exact search, got {steps}")
        if representation in ("spikes", "interval") and not global_perception:
            raise ValueError(f"global_perception: part of representation bssr, cannot be taken from {representation}")
        if motion_fusion in ("independent", "assembled") and not search:
            raise ValueError(
                f"motion_fusion: expected joint without search, which asks for no motion, got {motion_fusion}"
            )
        if end_width is not None and reconstruction == "separate":
            raise ValueError(f"end_width: separate colours are never fused, expected none, got {end_width}")
        settings = {
            **sizes,
            "pattern": bayer_pattern(pattern),
            "end_width": end_width,
            "skip": skip,
            "alpha": alpha,
            "representation": representation,
            "global_perception": global_perception,
            "motion_fusion": motion_fusion,
            "search": search,
            "refinement": refinement,
            "reconstruction": reconstruction,
            "resolution": resolution,
        }
        times = tuple(range(window // 2, frames - window // 2, stride))
        super().__init__(settings, (times[0], frames // 2, times[-1]), motion)
        self.times = times  # centres of the windows, in spike frames
        self.neighbors = neighbors
        self.steps = steps
        self.search = search
        self._fuse_motion = _choose("motion_fusion", motion_fusion, _MOTION_FUSIONS)
        represent = {
            "bssr": lambda: SpikeRepresentation(
                frames, window, stride, representation_width, features, global_perception
            ),
            "spikes": lambda: WindowMeans(window, stride),
            "interval": lambda: IntervalRepresentation(times),
        }
        encoder = _choose("representation", representation, represent)
        self.representation = nn.ModuleList(encoder() for _ in range(3))
        refine = FeatureRefinement if refinement else TimeFusion
        self.fold = _choose("resolution", resolution, {"output": 1, "sensor": scale})
        self.refinement = nn.ModuleList(
            refine(len(times), part.features * self.fold**2, width) for part in self.representation
        )
        reconstruct = _choose("reconstruction", reconstruction, _RECONSTRUCTIONS)
        wider = {} if end_width is None else {"end_width": end_width}
        self.reconstruction = reconstruct(width, stages, blocks, end_blocks, self.fold, **wider)
        self.skip = skip
        self.alpha = alpha
        self._initialize()
        self._masks: dict[Any, Tensor] = {}
        at_rest = search and self.fold == scale > 1
        self._response = rest_response(scale, settings["pattern"], sizes["neighbors"]) if at_rest else None
        self._responses: dict[Any, Tensor] = {}

    def _initialize(self) -> None:
        """Start nearly pixel by pixel: orthogonal centre taps, small ones around (Xiao et al., ICML 2018).

        A dozen random 3 x 3 filters in a row would blur what the network is to sharpen: training then rests for
        hundreds of steps on a plateau, or dies on it.
        """
        modules = list(nn.ModuleList([self.representation, self.refinement, self.reconstruction]).modules())
        for module in modules:
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                module.weight.data *= 0.2
                module.weight.data[:, :, 1, 1] += nn.init.orthogonal_(torch.empty(module.weight.shape[:2]), gain=1.2)
                nn.init.zeros_(module.bias)
        for module in modules:
            if isinstance(module, ResBlock):
                module.body[-1].weight.data *= 0.1
        for part in self.representation:
            if isinstance(part, SpikeRepresentation):
                part.start_at_the_mean()
        for part in self.refinement:
            if isinstance(part, TimeFusion):
                part.start_at_the_mean(self.fold**2)
        if self.skip:
            nn.init.zeros_(self.reconstruction.rgb.weight)

    def forward(self, spikes: Tensor, flow: Tensor | Literal[0] | None = None) -> Tensor:  # noqa: D102
        self._check_spikes(spikes)
        batch, _, height, width = spikes.shape
        spikes = spikes.to(self.reconstruction.rgb.weight.dtype)
        if flow is None:
            flow = 0 if isinstance(self.motion, ZeroFlow) else self.estimate_flow(spikes)
        shapes = (batch, 2, 2, height, width), (batch, 3, 2, 2, height, width)
        if flow.shape not in shapes if isinstance(flow, Tensor) else flow != 0:
            got = tuple(flow.shape) if isinstance(flow, Tensor) else repr(flow)
            raise ValueError(f"flow: expected {shapes[0]} or {shapes[1]} or 0, got {got}")
        planes = split_colors(spikes, self.pattern)
        # one colour after the other: high resolution takes memory
        features = (encode(plane) for encode, plane in zip(self.representation, planes, strict=True))
        response = None if isinstance(flow, Tensor) else self._response_for(spikes)
        if response is not None:
            colors = list(map(self._at_rest, features, self.refinement, response, range(3)))
        else:
            if self.search:
                offsets = self._offsets(flow, spikes)
                pixels = map(self._search, features, offsets, self._mask(height, width, spikes.device))
            else:
                pixels = (enlarge(part, self.scale) for part in features)
            pixels = (fold(part.flatten(1, 2), self.fold) for part in pixels)
            colors = [refine(part) for refine, part in zip(self.refinement, pixels, strict=True)]
        rgb = self.reconstruction(colors)
        return rgb + self._base(spikes) if self.skip else rgb

    def estimate_flow(self, spikes: Tensor) -> Tensor:
        """Flows from the middle to the first and to the last time point, in sensor pixels; zero if nothing is searched.

        Args:
            spikes: (B, N, H, W).

        Returns:
            (B, 2, 2, H, W), or (B, 3, 2, 2, H, W) where every colour has its own.
        """
        self._check_spikes(spikes)
        if not self.search:
            return torch.zeros(len(spikes), 2, 2, *spikes.shape[-2:], device=spikes.device)
        return self._fuse_motion(self.motion, spikes, self.flow_times, self.pattern)

    def _check_spikes(self, spikes: Tensor) -> None:
        check_planes("spikes", spikes, 4, "(B, N, H, W)")
        if spikes.ndim != 4 or spikes.shape[1] != self.frames or min(spikes.shape[-2:]) < 3:
            expected = f"(B, {self.frames}, H, W) of at least 3 x 3 pixels"
            raise ValueError(f"spikes: expected {expected}, got {tuple(spikes.shape)}")

    def _offsets(self, flow: Tensor | Literal[0], spikes: Tensor) -> Sequence[Tensor]:
        """How far every colour has moved at every time point, each (B, T, 2, s H, s W), T being 1 at rest."""
        if not isinstance(flow, Tensor):
            return [self._no_offset(spikes)] * 3
        flow = flow if flow.ndim == 6 else flow.unsqueeze(1)
        first, middle, last = self.flow_times
        offsets = linear_motion(
            flow[:, :, 0], flow[:, :, 1], self.times, first=first, middle=middle, last=last, scale=self.scale
        )
        return offsets.expand(-1, 3, -1, -1, -1, -1).unbind(1)

    def _no_offset(self, planes: Tensor) -> Tensor:
        height, width = planes.shape[-2:]
        return planes.new_zeros(len(planes), 1, 2, self.scale * height, self.scale * width)

    def _search(self, features: Tensor, offsets: Tensor, mask: Tensor) -> Tensor:
        """Temporal pixel search (section 4.3, Fig. 5 b): (B, T, C, H, W) to (B, T, C, s H, s W).

        Offsets of a single time point are those of all.
        """
        how = {"neighbors": self.neighbors, "steps": self.steps or None}
        if offsets.shape[1] == 1:
            pixels = enlarge(features, self.scale)
            return flow_warp_idw(pixels.flatten(1, 2), offsets[:, 0], mask, **how).reshape(pixels.shape)
        # a few time points after the others: what the search needs on the way is many times its result
        few = max(1, _SEARCHED // (offsets.shape[-2] * offsets.shape[-1]))
        pixels = [
            flow_warp_idw(enlarge(part, self.scale), offset, mask, **how)
            for part, offset in zip(features.flatten(0, 1).split(few), offsets.flatten(0, 1).split(few), strict=True)
        ]
        return torch.cat(pixels).unflatten(0, features.shape[:2])

    def _base(self, spikes: Tensor) -> Tensor:
        """TFP of the whole clip, demosaiced, smoothed, enlarged."""
        raw = tfp_at(spikes, self.frames // 2, self.frames) / self.alpha
        # zero at the Nyquist frequency, where demosaicing leaves a zipper that training would have to undo first
        binomial = raw.new_tensor([[0.25, 0.5, 0.25]])
        smooth = filter2d_separable(demosaic(raw, self.pattern), binomial, binomial)
        if self.scale == 1:
            return smooth
        return F.interpolate(smooth, scale_factor=self.scale, mode="bicubic", align_corners=False)

    def _mask(self, height: int, width: int, device: torch.device) -> tuple[Tensor, ...]:
        key = height, width, device
        if key not in self._masks:
            with torch.inference_mode(False):  # what is made in inference mode cannot be kept for a gradient
                mask = bayer_mask(height, width, self.pattern, scale=self.scale, device=device, dtype=torch.bool)
                # the same tensors every time: their tables are kept; at rest, a picture and its sides have three sizes
                self._masks = dict([*self._masks.items()][-2:]) | {key: mask.unbind(0)}
        return self._masks[key]

    def _response_for(self, spikes: Tensor) -> Tensor | None:
        """What temporal pixels are made of where nothing moves, if it is known, and of use for so large a picture."""
        if self._response is None or min(spikes.shape[-2:]) < WORTH_IT:
            return None
        key = spikes.device, torch.promote_types(spikes.dtype, torch.float32)
        if key not in self._responses:
            self._responses[key] = self._response.to(*key)
        return self._responses[key]

    def _at_rest(self, features: Tensor, refine: nn.Module, response: Tensor, color: int) -> Tensor:
        """Search and refinement of one colour where nothing moves: (B, T, C, H, W) to (B, width, H, W)."""

        def search(planes: Tensor) -> Tensor:
            mask = self._mask(*planes.shape[-2:], planes.device)[color]
            return fold(self._search(planes.unsqueeze(1), self._no_offset(planes), mask).flatten(1, 2), self.fold)

        return refine.finish(convolve_at_rest(features.flatten(1, 2), *refine.first(), response, search))
