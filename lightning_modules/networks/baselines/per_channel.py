"""Methods with a star in Table 2: one single-channel network reconstructs the four Bayer sub-streams separately."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from lightning_modules.motion.estimator import split_any_size
from spikekit import flow_warp
from spikekit.color.cfa import bayer_sites


def per_channel(
    reconstruct: Callable[[Tensor, Tensor], Tensor], spikes: Tensor, flow: Tensor, pattern: str, scale: int
) -> Tensor:
    r"""Reconstruct each Bayer sub-stream separately with one shared network, and merge the colours.

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
