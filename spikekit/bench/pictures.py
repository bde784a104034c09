"""The cases of the operators on pictures and features: warps, motion, the colour filter array, metrics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from kornia.color import CFA, raw_to_rgb, rgb_to_raw
from torch import Tensor

from spikekit.bench import plain
from spikekit.bench.case import Case, Other, Setup, floats, sizes
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
    image, flow = setup.rand(1, setup.size.channels, setup.size.side, setup.size.side), setup.flow()
    yield Case(
        f"float32 {sizes(image)}, forward",
        lambda: flow_warp(image, flow),
        flow[0, 0].numel(),
        *floats(image, 1, 1),
        [Other("F.grid_sample", lambda: partial(plain.grid_sample, image, flow), tolerance=1e-3)],
    )


def _flow_warp_idw(setup: Setup) -> Iterator[Case]:
    size, flow, scale = setup.size, setup.flow(), 2
    red, green, _ = bayer_mask(size.side // scale, size.side // scale, scale=scale, device=setup.device)
    features = setup.rand(1, size.channels, size.side, size.side)
    grad = setup.rand(2, *features.shape)[1]

    def case(colour: str, mask: Tensor, layout: str, backward: bool) -> Case:
        values = features.contiguous(memory_format=_LAYOUTS[layout])
        args = values, flow, grad if backward else None
        known = mask.mean().item() * values.numel()
        others = [
            Other(
                "F.grid_sample",
                lambda: partial(_warp, plain.grid_sample, *args),
                pair=None,
                note="bilinear, from all pixels: another operation",
            )
        ]
        if layout == "NCHW" and (colour == "R" or not backward):  # it takes a second and more
            search = partial(_warp, plain.idw_window, *args, mask=mask, radius=2 * scale + 1)
            others.append(Other("window and topk", lambda: search, _values, tolerance=1e-3))
        return Case(
            f"{colour}, {sizes(values)} {layout}, forward{' + backward' if backward else ''}",
            partial(_warp, flow_warp_idw, *args, mask=mask),
            flow[0, 0].numel(),
            4 * (known + flow.numel()) + backward * 4 * (values.numel() + known + flow.numel()),
            4 * values.numel() + backward * 4 * (values.numel() + flow.numel()),
            others,
        )

    def table(colour: str, mask: Tensor, channels: int) -> Case:
        values = features[:, :channels]
        exact = partial(_warp, flow_warp_idw, values, flow, None, mask=mask)
        return replace(
            case(colour, mask, "NCHW", backward=False),
            name=f"{colour}, {sizes(values)} NCHW, forward, steps = 16",
            run=partial(exact, steps=16),
            read=4 * (mask.mean().item() * values.numel() + flow.numel()),
            written=4 * values.numel(),
            others=[
                Other("without steps", lambda: exact, _values, 1 / 16, "an approximation: within 1/16, on noise"),
                Other("search, then gather", lambda: partial(_search_then_gather, values, flow, mask), _values),
            ],
        )

    for layout in _LAYOUTS:
        for backward in (False, True):
            yield case("R", red, layout, backward)
            yield case("G", green, layout, backward)
    for channels in dict.fromkeys((2, size.channels)):
        yield table("R", red, channels)
        yield table("G", green, channels)


_LAYOUTS = {"NCHW": torch.contiguous_format, "channels-last": torch.channels_last}


def _values(ours: tuple[Tensor, ...], other: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Pick the result, or, where there is one, the gradient to the features."""
    return ours[:2][-1], other[:2][-1]


def _warp(warp: Any, features: Tensor, flow: Tensor, grad: Tensor | None, **options: Any) -> tuple[Tensor, ...]:
    """Warp; where there is a gradient, take it back to the features and to the flow."""
    if grad is None:
        return (warp(features, flow, **options),)
    features, flow = features.detach().requires_grad_(), flow.detach().requires_grad_()
    result = warp(features, flow, **options)
    return (result.detach(), *torch.autograd.grad(result, (features, flow), grad))


def _search_then_gather(features: Tensor, flow: Tensor, mask: Tensor) -> tuple[Tensor]:
    """The path that runs where Numba is not installed."""
    return (Gather.apply(features.flatten(2), *idw_neighbors(flow, mask, steps=16)).reshape(features.shape),)


def _mosaic(setup: Setup) -> Iterator[Case]:
    rgb = setup.rand(8, 3, setup.size.height, setup.size.width)
    yield Case(
        f"float32 {sizes(rgb)}",
        lambda: mosaic(rgb),
        rgb[:, 0].numel(),
        *floats(rgb[:, 0], 1, 1),
        [Other("kornia rgb_to_raw", lambda: lambda: rgb_to_raw(rgb, CFA.BG), lambda a, b: (a, b[:, 0]))],
    )


def _bin_to_sensor(setup: Setup) -> Iterator[Case]:
    rgb = setup.rand(8, 3, 2 * setup.size.height, 2 * setup.size.width)
    yield Case(
        f"float32 {sizes(rgb)}, scale 2",
        lambda: bin_to_sensor(rgb, scale=2),
        rgb[:, 0].numel() // 4,
        *floats(rgb[:, 0], 1, 0.25),
        [
            Other(
                "F.avg_pool2d, kornia rgb_to_raw",
                lambda: lambda: rgb_to_raw(F.avg_pool2d(rgb, 2), CFA.BG),
                lambda a, b: (a, b[:, 0]),
            )
        ],
    )


def _split_colors(setup: Setup) -> Iterator[Case]:
    spikes = setup.spikes(setup.size.clip)
    yield Case(
        f"uint8 {sizes(spikes)}",
        lambda: split_colors(spikes),
        spikes.numel(),
        spikes.numel(),
        3 * spikes.numel(),
        [Other("plain torch", lambda: partial(plain.split_colors, spikes, "RGGB"))],
    )


def _demosaic(setup: Setup) -> Iterator[Case]:
    raw = setup.rand(8, setup.size.height, setup.size.width)
    yield Case(
        f"float32 {sizes(raw)}",
        lambda: demosaic(raw),
        raw.numel(),
        *floats(raw, 1, 3),
        [
            Other(
                "kornia raw_to_rgb",
                lambda: lambda: raw_to_rgb(raw[:, None], CFA.BG),
                pair=None,
                note="bilinear, 2 of 13 pixels that these filters read: another algorithm",
            )
        ],
    )


def _demosaic_residual(setup: Setup) -> Iterator[Case]:
    raw = setup.rand(2, setup.size.height, setup.size.width)
    yield Case(
        f"float32 {sizes(raw)}",
        lambda: demosaic_residual(raw),
        raw.numel(),
        *floats(raw, 1, 3),
        [Other("demosaic", lambda: partial(demosaic, raw), pair=None, note="Malvar's linear filters: worse pictures")],
    )


def _demosaic_along_motion(setup: Setup) -> Iterator[Case]:
    raw = setup.rand(5, setup.size.side, setup.size.side)
    flow = setup.flow() * torch.linspace(-1, 1, 5, device=setup.device).reshape(5, 1, 1, 1)
    yield Case(
        f"float32 {sizes(raw)}",
        lambda: demosaic_along_motion(raw, flow),
        raw[0].numel(),
        4 * (raw.numel() + flow.numel()),
        3 * 4 * raw[0].numel(),
        [
            Other(
                "demosaic_residual",
                lambda: partial(demosaic_residual, raw[2]),
                pair=None,
                note="the middle mosaic alone: worse pictures",
            )
        ],
    )


def _linear_motion(setup: Setup) -> Iterator[Case]:
    flow = setup.flow()
    times = list(range(5, 36, 3))
    yield Case(
        f"float32 {sizes(flow)} -> 11 times, scale 2",
        lambda: linear_motion(flow, -flow, times, scale=2),
        11 * 4 * flow[0, 0].numel(),
        *floats(flow, 2, 44),
        [Other("plain torch", lambda: partial(plain.linear_motion, flow, -flow, times, 2))],
    )


def _ssim(setup: Setup) -> Iterator[Case]:
    rgb = setup.rand(2, 3, setup.size.height, setup.size.width)

    def scikit_image() -> Run:
        from skimage.metrics import structural_similarity

        a, b = (picture.permute(1, 2, 0).cpu().numpy() for picture in rgb)
        return lambda: torch.tensor(structural_similarity(a, b, channel_axis=2, data_range=1.0))

    yield Case(
        f"float32 {sizes(rgb[0])}",
        lambda: ssim(rgb[0], rgb[1]),
        rgb[0, 0].numel(),
        *floats(rgb, 1, 0),
        [Other("scikit-image", scikit_image)],
    )


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
