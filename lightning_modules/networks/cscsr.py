"""CSCSR: colour spike camera super-resolution (Dong et al., CVPR 2024)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.compiler import is_exporting

from lightning_modules.motion import MotionEstimator
from lightning_modules.networks.cscsr_config import CSCSRConfig
from lightning_modules.networks.layers import channels_last, enlarge, enlarge_smoothly, fold, start_pixel_by_pixel
from lightning_modules.networks.motion_fusion import assembled_motion, independent_motion, joint_motion
from lightning_modules.networks.network import Network
from lightning_modules.networks.reconstruction import CellReconstruction, ColorCorrelation, EarlyFusion, SeparateColors
from lightning_modules.networks.refinement import FeatureRefinement, TimeFusion
from lightning_modules.networks.representation import IntervalRepresentation, SpikeRepresentation, WindowMeans
from lightning_modules.signatures import inherit_signature
from spikekit import bayer_mask, demosaic, flow_warp_idw, linear_motion, tfp_at
from spikekit.color.cfa import bayer_sites, count_colors
from spikekit.filters import separable_filter
from spikekit.kernels import compiler_kept_out
from spikekit.warp.site_search import SMALLEST, apart, search_sites, site_table

_MOTION_FUSIONS = {"joint": joint_motion, "independent": independent_motion, "assembled": assembled_motion}
_RECONSTRUCTIONS = {"correlated": ColorCorrelation, "separate": SeparateColors, "early": EarlyFusion}


def one_a_clip(name: str, value: float | Tensor, clips: Tensor) -> Tensor:
    """Return a number, or one number per clip (B,), in a shape that broadcasts with the clips, (B, 1, ...)."""
    value = torch.as_tensor(value, dtype=clips.dtype, device=clips.device)
    if value.shape not in ((), (len(clips),)):
        raise ValueError(f"{name}: expected a number or shape ({len(clips)},), got {tuple(value.shape)}")
    return value.reshape(-1, *[1] * (clips.ndim - 1)).expand(len(clips), *[1] * (clips.ndim - 1))


def _representation(config: CSCSRConfig) -> nn.Module:
    """Build the module that extracts the features of one colour at each time point."""
    if config.representation == "spikes":
        return WindowMeans(config.window, config.stride)
    if config.representation == "interval":
        return IntervalRepresentation(config.times)
    return SpikeRepresentation(
        config.frames,
        config.window,
        config.stride,
        config.representation_width,
        config.features,
        config.global_perception,
        config.noise and not config.noise_blocks,
    )


def _reconstruction(config: CSCSRConfig, colors: int, enlarge: int) -> nn.Module:
    """Build the module that makes the picture."""
    if config.resolution == "cell":
        return CellReconstruction(config.frames, config.width, config.end_blocks, enlarge, colors, config.noise)
    own = {} if config.end_width is None else {"end_width": config.end_width}
    own |= {"colors": 1} if colors == 1 else {}
    own |= {"noise": not config.noise_blocks, "noise_blocks": config.noise_blocks} if config.noise else {}
    kind = _RECONSTRUCTIONS[config.reconstruction]
    return kind(config.width, config.stages, config.blocks, config.end_blocks, enlarge, **own)


@compiler_kept_out
@lru_cache(maxsize=32)
def _shares(times: tuple[int, ...], flow_times: tuple[int, int, int], device: torch.device) -> Tensor:
    """Return the weights (T, 2) of the flows to the first and last time points in the motion to each time point."""
    first, middle, last = flow_times
    shares = [[max(0.0, (t - middle) / (end - middle)) for end in (first, last)] for t in times]
    return apart(lambda: torch.tensor(shares, device=device))


@lru_cache(maxsize=6)
def _masks(height: int, width: int, pattern: str, scale: int, device: torch.device) -> tuple[Tensor, ...]:
    """Return the colour masks; the cache returns the same tensors each time, so the search reuses its tables."""
    with torch.inference_mode(False):  # autograd cannot save inference tensors
        return bayer_mask(height, width, pattern, scale=scale, device=device, dtype=torch.bool).unbind(0)


def _kept_near(offsets: Tensor) -> Tensor:
    """Clamp offsets (..., 2, H, W) so that they point no more than half a pixel beyond the picture's border."""
    kept = []
    for axis, offset in zip((-1, -2), offsets.unbind(-3), strict=True):
        length = offset.shape[axis]
        at = torch.arange(length, device=offset.device, dtype=offset.dtype)
        at = at if axis == -1 else at.unsqueeze(-1)
        kept.append(offset.maximum(-0.5 - at).minimum(length - 0.5 - at))
    return torch.stack(kept, dim=-3)


class CSCSR(Network):
    r"""Colour spike camera super-resolution, from a Bayer-pattern spike stream or from that of a grey sensor.

    The network reconstructs the picture at the middle of the clip. At scale 1 it keeps the sensor's resolution, and
    the temporal pixel search collects each pixel's values at other times.

    Args:
        *args: fields of :class:`CSCSRConfig`, in its order; ``CSCSR(4)`` is ``CSCSR(scale=4)``.
        motion: motion estimator, called when no flow is given. Default:
            :class:`lightning_modules.motion.ClassicalFlow`.
        **settings: fields of :class:`CSCSRConfig`, by name.

    Attributes:
        config: the configuration.

    Shape:
        - Input: spikes :math:`(B, N, H, W)`, zeros and ones of any real dtype, with H and W of at least 3. Optional:
          ``flow`` from the middle to the first and last time points, in sensor pixels, :math:`(B, 2, 2, H, W)`, or one
          flow per colour, :math:`(B, 3, 2, 2, H, W)`; ``static=True`` for a scene without motion, which gives the
          result of zero flow faster; ``alpha``, the gain of the camera; ``noise``, the noise level, 0 for an ideal
          sensor and 1 for the sensor used in training, whose defects are filled, see :func:`spikekit.fill_defects`.
          ``alpha`` and ``noise`` are numbers or :math:`(B,)`
        - Output: rgb :math:`(B, 3, s H, s W)`, or :math:`(B, 1, s H, s W)` for a grey sensor, not clamped

    Raises:
        ValueError: :class:`CSCSRConfig` rejects a field, or ``noise`` is given to a network trained without it.

    Example:
        >>> network = CSCSR(scale=2, width=8, representation_width=8, features=1, stages=1, end_blocks=1)
        >>> network(torch.zeros(1, 41, 12, 10), torch.zeros(1, 2, 2, 12, 10)).shape
        torch.Size([1, 3, 24, 20])

    Reference:
        Dong et al., Super-Resolution Reconstruction from Bayer-Pattern Spike Streams, CVPR 2024.
    """

    halo = 16  #: upper bound for all shipped networks; weights define their own
    flow_groups = ((), (3,))
    configuration: ClassVar[type[CSCSRConfig]] = CSCSRConfig  #: class of ``config``

    @inherit_signature(CSCSRConfig)
    def __init__(self, *args: Any, motion: MotionEstimator | None = None, **settings: Any) -> None:
        config = self.configuration(*args, **settings)
        times = config.times
        super().__init__(config.settings, (times[0], config.frames // 2, times[-1]), motion)
        self.config = config
        self.takes_flow = config.search
        self.times = times
        self.colors = count_colors(config.pattern)
        self.fold = {"output": 1, "sensor": config.scale, "cell": 2 * config.scale}[config.resolution]
        parts = 0 if config.resolution == "cell" else self.colors
        self.representation = nn.ModuleList(_representation(config) for _ in range(parts))
        refine = FeatureRefinement if config.refinement else TimeFusion
        self._side = self.fold if config.search else 1  # of the square of temporal pixels that a feature becomes
        self.refinement = nn.ModuleList(
            refine(len(times), part.features * self._side**2, config.width) for part in self.representation
        )
        self.reconstruction = _reconstruction(config, self.colors, self.fold)
        if not self.reconstruction.rgb.weight.is_meta:
            self._initialize()

    def _initialize(self) -> None:
        for part in (self.representation, self.refinement, self.reconstruction):
            start_pixel_by_pixel(part)
        for part in self.representation:
            if isinstance(part, SpikeRepresentation):
                part.start_at_the_mean()
        for part in self.refinement:
            if isinstance(part, TimeFusion):
                part.start_at_the_mean(self._side**2)
        if self.config.noise_blocks:  # no correction before training
            for block in self.reconstruction.correction:
                nn.init.zeros_(block.body[-1].weight)
        if self.config.skip:
            nn.init.zeros_(self.reconstruction.rgb.weight)
        if isinstance(self.reconstruction, CellReconstruction):
            self.reconstruction.start_at_the_mean()

    def forward(  # noqa: D102
        self,
        spikes: Tensor,
        flow: Tensor | None = None,
        static: bool = False,
        alpha: float | Tensor | None = None,
        noise: float | Tensor | None = None,
    ) -> Tensor:
        self.check_spikes(spikes)
        if self.config.resolution == "cell":
            return self._exposed(self._by_cells(spikes, noise), alpha)
        spikes = spikes.to(self.reconstruction.rgb.weight.dtype)
        told = self._told(noise, spikes)
        rgb = self.reconstruction(self._colors(spikes, self.resolve_flow(spikes, flow, static), **told), **told)
        rgb = rgb.add_(self._base(spikes)) if self.config.skip else rgb
        return self._exposed(F.pixel_shuffle(rgb, self.fold), alpha)

    def _by_cells(self, spikes: Tensor, noise: float | Tensor | None) -> Tensor:
        """Return the picture by cells of 2 x 2 pixels, red first; borders are mirrored to whole cells."""
        height, width = spikes.shape[-2:]
        (_, top, left), *_ = bayer_sites("RGGB" if self.colors == 1 else self.pattern)
        border = left, (left + width) % 2, top, (top + height) % 2
        planes = self._tfp(spikes)
        told = self._told(noise, planes)
        auto = torch.is_autocast_enabled(spikes.device.type)
        dtype = torch.get_autocast_dtype(spikes.device.type) if auto else planes.dtype
        if any(border) or spikes.dtype.itemsize > dtype.itemsize:  # bytes are packed as they are, which is faster
            spikes = spikes.to(dtype)
        whole = (F.pad(part, border, "reflect") if any(border) else part for part in (spikes, planes))
        rgb = F.pixel_shuffle(self.reconstruction(*whole, **told), self.fold)
        top, left, height, width = (self.scale * length for length in (top, left, height, width))
        return rgb[..., top : top + height, left : left + width]

    def _told(self, noise: float | Tensor | None, spikes: Tensor) -> dict[str, Tensor]:
        """Return the noise level of clips (B, N, H, W) as a keyword argument (B, 1, 1, 1), or no argument."""
        if noise is None and self.config.noise and self.noise_level:
            noise = self.noise_level
        if noise is None:
            return {}
        if not self.config.noise:
            raise ValueError(f"noise: expected None for a network trained without noise levels, got {noise}")
        return {"noise": one_a_clip("noise", noise, spikes)}

    def _exposed(self, rgb: Tensor, alpha: float | Tensor | None) -> Tensor:
        """Scale pictures (B, ..., C, H, W) to the gain of their cameras."""
        return rgb if alpha is None else rgb * (self.config.alpha / one_a_clip("alpha", alpha, rgb))

    def _colors(self, spikes: Tensor, flow: Tensor | None, **told: Tensor) -> list[Tensor]:
        """Return the refined features of each colour, (B, width, H, W), at the resolution of the reconstruction."""
        if torch.is_autocast_enabled(spikes.device.type):  # before they are copied
            spikes = spikes.to(torch.get_autocast_dtype(spikes.device.type))
        masks = bayer_mask(*spikes.shape[-2:], self.pattern, device=spikes.device, dtype=spikes.dtype)
        spikes = channels_last(spikes)
        planes = (spikes * mask for mask in masks)
        # one colour at a time, to save memory
        features = (encode(plane, **told) for encode, plane in zip(self.representation, planes, strict=True))
        if not self.config.search:
            pixels = (enlarge(part, self.scale // self.fold) for part in features)
        elif flow is None and self.colors == 1:  # a grey sensor at rest knows all pixels
            pixels = (enlarge(part, self.scale) for part in features)
        elif self._by_sites(spikes, flow):
            pixels = self._search_sites(features, flow, spikes)
            return [refine(part) for refine, part in zip(self.refinement, pixels, strict=True)]
        elif is_exporting():
            got = f"{self.config.neighbors} and {tuple(spikes.shape[-2:])}"
            raise ValueError(f"neighbors, H, W: expected at most 4 and at least {SMALLEST} for export, got {got}")
        else:
            pixels = map(self._search, features, self._offsets(flow, spikes), range(self.colors))
        pixels = (fold(part.flatten(1, 2), self._side) for part in pixels)
        return [refine(part) for refine, part in zip(self.refinement, pixels, strict=True)]

    def _by_sites(self, spikes: Tensor, flow: Tensor | None) -> bool:
        """Return whether one search per sensor pixel is possible; it has no gradient with respect to the flow."""
        learned = flow is not None and flow.requires_grad and torch.is_grad_enabled()
        if learned or torch.jit.is_tracing():
            return False
        return self.config.neighbors <= 4 and min(spikes.shape[-2:]) >= SMALLEST

    def _search_sites(self, features: Iterable[Tensor], flow: Tensor | None, spikes: Tensor) -> Iterator[Tensor]:
        """Run the temporal pixel search for each colour, (B, T, C, H, W) to the input of the refinement."""
        height, width = spikes.shape[-2:]
        moved = spikes.new_zeros(len(spikes), 2, 2, height, width) if flow is None else flow
        flows = moved.unbind(1) if moved.ndim == 6 else [moved] * self.colors
        shares = _shares(self.times, self.flow_times, spikes.device)
        for color, (part, one) in enumerate(zip(features, flows, strict=True)):
            of_border = bool(height % 2), bool(width % 2)  # of an export, symbols until then
            how = self.config.neighbors, self.config.representation != "bssr"
            table = site_table(self.pattern, color, self.scale, of_border, spikes.device, *how)
            pixels = search_sites(part, one, shares, table)
            yield pixels if self.fold == self.scale else F.pixel_shuffle(pixels, self.scale)

    @torch.no_grad()
    def scale_picture(self, factor: float) -> None:  # noqa: D102
        self.reconstruction.rgb.weight *= factor
        self.reconstruction.rgb.bias *= factor

    def estimate_flow(self, spikes: Tensor) -> Tensor:
        """Estimate the flows from the middle to the first and last time points; zero for networks without search.

        Args:
            spikes: (B, N, H, W).

        Returns:
            Flows in sensor pixels, (B, 2, 2, H, W), or (B, 3, 2, 2, H, W) with one flow per colour.
        """
        self.check_spikes(spikes)
        if not self.config.search:
            return torch.zeros(len(spikes), 2, 2, *spikes.shape[-2:], device=spikes.device)
        return _MOTION_FUSIONS[self.config.motion_fusion](self.motion, spikes, self.flow_times, self.pattern)

    def _offsets(self, flow: Tensor | None, spikes: Tensor) -> Sequence[Tensor]:
        """Return the displacement of each colour at each time point, (B, T, 2, s H, s W); T is 1 at rest."""
        if flow is None:
            size = [self.scale * length for length in spikes.shape[-2:]]
            return [spikes.new_zeros(len(spikes), 1, 2, *size)] * self.colors
        flow = flow if flow.ndim == 6 else flow.unsqueeze(1)
        first, middle, last = self.flow_times
        offsets = linear_motion(
            flow[:, :, 0], flow[:, :, 1], self.times, first=first, middle=middle, last=last, scale=self.scale
        )
        return _kept_near(offsets).expand(-1, self.colors, -1, -1, -1, -1).unbind(1)

    def _search(self, features: Tensor, offsets: Tensor, color: int) -> Tensor:
        """Run the temporal pixel search (section 4.3, Fig. 5 b), (B, T, C, H, W) to (B, T, C, s H, s W).

        Offsets with T = 1 apply to all time points.
        """
        neighbors = self.config.neighbors
        mask = _masks(*features.shape[-2:], self.pattern, self.scale, features.device)[color]
        if offsets.shape[1] == 1:
            pixels = self._enlarge(features, mask)
            return flow_warp_idw(pixels.flatten(1, 2), offsets[:, 0], mask, neighbors=neighbors).reshape(pixels.shape)
        pixels = [  # one time point at a time: the search needs many times the memory of its result
            flow_warp_idw(self._enlarge(part, mask), offset, mask, neighbors=neighbors)
            for part, offset in zip(features.unbind(1), offsets.unbind(1), strict=True)
        ]
        return torch.stack(pixels, dim=1)

    def _enlarge(self, features: Tensor, mask: Tensor) -> Tensor:
        """Enlarge features; those without weights are zero at other colours' pixels, so they are renormalised."""
        pixels = enlarge(features, self.scale)
        if self.config.representation == "bssr" or self.scale == 1:
            return pixels
        known = enlarge(mask[None, :: self.scale, :: self.scale].to(pixels.dtype), self.scale)
        return pixels / known.where(mask, 1)

    def _tfp(self, spikes: Tensor) -> Tensor:
        """Return the TFP picture (B, 1, H, W): of the whole clip, or of third order for a grey sensor."""
        window, order = ((self.frames - 1) // 6 * 2 + 1, 3) if self.colors == 1 else (self.frames, 1)
        dtype = self.reconstruction.rgb.weight.dtype
        return tfp_at(spikes, self.frames // 2, window, order=order, dtype=dtype).unsqueeze(1) / self.config.alpha

    def _base(self, spikes: Tensor) -> Tensor:
        """Return the enlarged TFP picture, as ``reconstruction`` does; not in bfloat16, which has too few levels.

        It is demosaiced and smoothed, except that of a grey sensor.
        """
        with torch.autocast(spikes.device.type, enabled=False):
            planes = self._tfp(spikes)
            if self.colors > 1:
                # zero at the Nyquist frequency, to remove the zipper artefacts of demosaicing
                planes = separable_filter(demosaic(planes[:, 0], self.pattern), (0.25, 0.5, 0.25))
            large = enlarge_smoothly(planes, self.scale)
            return large if self.fold == self.scale else F.pixel_shuffle(large, self.scale)
