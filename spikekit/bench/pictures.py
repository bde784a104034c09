"""The cases of the operators on pictures and features: warps, motion, the colour filter array, metrics."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from kornia.color import CFA, raw_to_rgb, rgb_to_raw
from torch import Tensor

from spikekit.bench import plain
from spikekit.bench.case import Case, Other, Setup, other, sizes
from spikekit.color.cfa import bayer_mask, bin_to_sensor, mosaic, split_colors
from spikekit.color.demosaic import demosaic
from spikekit.color.residual_demosaic import demosaic_residual
from spikekit.flow.fields import linear_motion
from spikekit.metrics import ssim
from spikekit.timing import Run
from spikekit.warp.gather import Gather
from spikekit.warp.motion_demosaic import demosaic_along_motion
from spikekit.warp.neighbors import idw_neighbors
from spikekit.warp.warp import flow_warp, flow_warp_idw


def _flow_warp(setup: Setup) -> Iterator[Case]:
    image = setup.rand(1, setup.size.channels, setup.size.side, setup.size.side)
    work = {"channels": setup.size.channels, "read": image.nbytes}
    others = [other("F.grid_sample", plain.grid_sample, tolerance=1e-3)]
    yield Case(f"float32 {sizes(image)}, forward", flow_warp, (image, setup.flow()), others, **work)


def _flow_warp_idw(setup: Setup) -> Iterator[Case]:
    size, flow, scale = setup.size, setup.flow(), 2
    red, green, _ = bayer_mask(size.side // scale, size.side // scale, scale=scale, device=setup.device)
    features = setup.rand(1, size.channels, size.side, size.side)
    grad = setup.rand(2, *features.shape)[1]

    def case(colour: str, mask: Tensor, layout: str, backward: bool) -> Case:
        values = features.contiguous(memory_format=_LAYOUTS[layout])
        note = "bilinear, from all pixels: another operation"
        others = [other("F.grid_sample", partial(_warp, plain.grid_sample), None, note=note)]
        if layout == "NCHW" and (colour == "R" or not backward):  # it takes a second and more
            search = partial(_warp, plain.idw_window, mask=mask, radius=2 * scale + 1)
            others.append(other("window and topk", search, _values, tolerance=1e-3))
        known = mask.mean().item() * values.nbytes
        return Case(
            f"{colour}, {sizes(values)} {layout}, forward{' + backward' if backward else ''}",
            partial(_warp, flow_warp_idw, mask=mask),
            (values, flow, grad if backward else None),
            others,
            channels=size.channels,
            read=known + flow.nbytes + backward * (values.nbytes + known + flow.nbytes),
            written=values.nbytes + backward * (values.nbytes + flow.nbytes),
        )

    def table(colour: str, mask: Tensor, channels: int) -> Case:
        values = features[:, :channels]
        exact = partial(_warp, flow_warp_idw, mask=mask)
        note = "an approximation: within 1/16, on noise"
        return Case(
            f"{colour}, {sizes(values)} NCHW, forward, steps = 16",
            partial(exact, steps=16),
            (values, flow, None),
            [
                other("without steps", exact, _values, tolerance=1 / 16, note=note),
                other("search, then gather", partial(_search_then_gather, mask=mask), _values),
            ],
            channels=channels,
            read=mask.mean().item() * values.nbytes + flow.nbytes,
        )

    for layout in _LAYOUTS:
        for backward in (False, True):
            yield case("R", red, layout, backward)
            yield case("G", green, layout, backward)
    for channels in dict.fromkeys((2, size.channels)):
        yield table("R", red, channels)
        yield table("G", green, channels)


_LAYOUTS = {"NCHW": torch.contiguous_format, "channels-last": torch.channels_last}


def _values(ours: tuple[Tensor, ...], theirs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Pick the result, or, where there is one, the gradient to the features."""
    return ours[:2][-1], theirs[:2][-1]


def _warp(warp: Any, features: Tensor, flow: Tensor, grad: Tensor | None, **options: Any) -> tuple[Tensor, ...]:
    """Warp; where there is a gradient, take it back to the features and to the flow."""
    if grad is None:
        return (warp(features, flow, **options),)
    features, flow = features.detach().requires_grad_(), flow.detach().requires_grad_()
    result = warp(features, flow, **options)
    return (result.detach(), *torch.autograd.grad(result, (features, flow), grad))


def _search_then_gather(features: Tensor, flow: Tensor, _: None, mask: Tensor) -> tuple[Tensor]:
    """The path that runs where Numba is not installed."""
    return (Gather.apply(features.flatten(2), *idw_neighbors(flow, mask, steps=16)).reshape(features.shape),)


def _mosaic(setup: Setup) -> Iterator[Case]:
    rgb = setup.rand(8, 3, setup.size.height, setup.size.width)
    others = [other("kornia rgb_to_raw", lambda rgb: rgb_to_raw(rgb, CFA.BG)[:, 0])]
    yield Case(f"float32 {sizes(rgb)}", mosaic, (rgb,), others, read=rgb.nbytes / 3)


def _bin_to_sensor(setup: Setup) -> Iterator[Case]:
    rgb = setup.rand(8, 3, 2 * setup.size.height, 2 * setup.size.width)
    others = [other("F.avg_pool2d, kornia rgb_to_raw", lambda rgb: rgb_to_raw(F.avg_pool2d(rgb, 2), CFA.BG)[:, 0])]
    yield Case(f"float32 {sizes(rgb)}, scale 2", partial(bin_to_sensor, scale=2), (rgb,), others, read=rgb.nbytes / 3)


def _split_colors(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.clip)
    others = [other("plain torch", partial(plain.split_colors, pattern="RGGB"))]
    yield Case(f"uint8 {sizes(spikes)}", split_colors, (spikes,), others, channels=3)


def _demosaic(setup: Setup) -> Iterator[Case]:
    raw = setup.rand(8, setup.size.height, setup.size.width)
    note = "bilinear, 2 of 13 pixels that these filters read: another algorithm"
    others = [other("kornia raw_to_rgb", lambda raw: raw_to_rgb(raw[:, None], CFA.BG), None, note=note)]
    yield Case(f"float32 {sizes(raw)}", demosaic, (raw,), others, channels=3)


def _demosaic_residual(setup: Setup) -> Iterator[Case]:
    raw = setup.rand(2, setup.size.height, setup.size.width)
    others = [other("demosaic", demosaic, None, note="Malvar's linear filters: worse pictures")]
    yield Case(f"float32 {sizes(raw)}", demosaic_residual, (raw,), others, channels=3)


def _demosaic_along_motion(setup: Setup) -> Iterator[Case]:
    raw = setup.rand(5, setup.size.side, setup.size.side)
    flow = setup.flow() * torch.linspace(-1, 1, 5, device=setup.device).reshape(5, 1, 1, 1)
    note = "the middle mosaic alone: worse pictures"
    others = [other("demosaic_residual", lambda raw, _: demosaic_residual(raw[2]), None, note=note)]
    yield Case(f"float32 {sizes(raw)}", demosaic_along_motion, (raw, flow), others, channels=3)


def _linear_motion(setup: Setup) -> Iterator[Case]:
    flow, times = setup.flow(), list(range(5, 36, 3))
    ours, theirs = (partial(function, times=times, scale=2) for function in (linear_motion, plain.linear_motion))
    others = [other("plain torch", theirs)]
    yield Case(f"float32 {sizes(flow)} -> 11 times, scale 2", ours, (flow, -flow), others, channels=2)


def _ssim(setup: Setup) -> Iterator[Case]:
    def scikit_image(*rgb: Tensor) -> Run:
        from skimage.metrics import structural_similarity

        a, b = (picture.permute(1, 2, 0).cpu().numpy() for picture in rgb)
        return lambda: torch.tensor(structural_similarity(a, b, channel_axis=2, data_range=1.0))

    rgb = setup.rand(2, 3, setup.size.height, setup.size.width).unbind()
    pixels = rgb[0][0].numel()
    yield Case(f"float32 {sizes(rgb[0])}", ssim, rgb, [Other("scikit-image", scikit_image)], pixels=pixels, written=0)


#: The cases of every operator, made one after the other so that only one set of inputs is in memory.
CASES = {
    "flow_warp": _flow_warp,
    "flow_warp_idw": _flow_warp_idw,
    "linear_motion": _linear_motion,
    "mosaic": _mosaic,
    "bin_to_sensor": _bin_to_sensor,
    "split_colors": _split_colors,
    "demosaic": _demosaic,
    "demosaic_residual": _demosaic_residual,
    "demosaic_along_motion": _demosaic_along_motion,
    "ssim": _ssim,
}
