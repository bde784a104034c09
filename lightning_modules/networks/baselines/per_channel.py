"""The star of Table 2: one network of one colour, which reconstructs the four Bayer sub-streams one by one."""

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
    r"""Reconstruct every Bayer sub-stream by itself with one shared network, and put the colours together.

    The paper says of VidarSR\* and SpikeSR-Net\* that they handle "each color channel separately", and no more. How is
    ours: the four sub-streams, each half as large as the sensor, are enlarged by 2 s, moved by the half pixel of the
    sensor that their sites are off the middle of the Bayer cell, bilinearly, and the two greens are averaged.

    ``reconstruct`` maps the spikes of sub-streams, (4 B, N, h, w), and their flows, (4 B, 2, 2, h, w), in pixels of the
    sub-streams, to pictures of one channel, (4 B, 1, 2 s h, 2 s w); what is returned is rgb, (B, 3, s H, s W).
    """
    batch, (height, width) = len(spikes), spikes.shape[-2:]
    planes = split_any_size(spikes, pattern)
    flows = split_any_size(flow.flatten(1, 2), pattern).unflatten(2, (2, 2)) / 2
    pictures = reconstruct(planes.flatten(0, 1), flows.flatten(0, 1)).unflatten(0, (4, batch))
    colors: list[list[Tensor]] = [[], [], []]
    for picture, (color, row, column) in zip(pictures, bayer_sites(pattern), strict=True):
        # the value at (x, y) stands at (x, y) + shift in the picture of the sub-stream
        shift = picture.new_tensor([scale / 2 - scale * column, scale / 2 - scale * row]).reshape(1, 2, 1, 1)
        colors[color].append(flow_warp(picture, shift.expand(batch, 2, *picture.shape[-2:])))
    rgb = torch.cat([torch.stack(found).mean(dim=0) for found in colors], dim=1)
    return rgb[..., : scale * height, : scale * width]
