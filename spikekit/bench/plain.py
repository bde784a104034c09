"""The operators in plain torch, independent of spikekit, for the benchmark to compare with.

Unless a function says otherwise, its result equals that of the operator.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor


def unpack(packed: Tensor) -> Tensor:
    """Every pixel takes its bit; rows are a multiple of 8 pixels wide."""
    bits = packed[..., None] >> torch.arange(8, dtype=torch.uint8, device=packed.device) & 1
    return bits.flatten(-2)


def pack(spikes: Tensor) -> Tensor:
    """Every byte adds its bits up."""
    bits = spikes.unflatten(-1, (-1, 8)) << torch.arange(8, dtype=torch.uint8, device=spikes.device)
    return bits.sum(-1, dtype=torch.uint8)


def read_dat(path: str, height: int, width: int) -> Tensor:
    """Decode a recording that is stored upside down."""
    return unpack(torch.from_numpy(np.fromfile(path, np.uint8)).reshape(-1, height, width // 8)).flip(-2)


def write_dat(path: str, spikes: Tensor) -> None:
    """Encode a recording upside down."""
    pack(spikes.flip(-2)).numpy().tofile(path)


def intervals(spikes: Tensor) -> Tensor:
    """Eq. (4) in two passes; where there is no spike before or none after, what comes out means nothing."""
    frames = len(spikes)
    last = torch.full(spikes.shape[1:], -1, device=spikes.device)
    before, after = [], []
    for n in range(frames):
        before.append(last)
        last = torch.where(spikes[n] != 0, n, last)
    following = torch.full_like(last, frames)
    for n in reversed(range(frames)):
        following = torch.where(spikes[n] != 0, n, following)
        after.append(following)
    return torch.stack(after[::-1]) - torch.stack(before)


def tfi_frame(spikes: Tensor, n: int) -> Tensor:
    """One picture by eq. (4)-(5): search for the spike before and for the spike after."""
    last = torch.full(spikes.shape[1:], -1, device=spikes.device)
    for k in range(n - 1, -1, -1):
        last = torch.where((last < 0) & (spikes[k] != 0), k, last)
    following = torch.full_like(last, len(spikes))
    for k in range(n, len(spikes)):
        following = torch.where((following == len(spikes)) & (spikes[k] != 0), k, following)
    return 1 / (following - last)


def tfp(spikes: Tensor, window: int) -> Tensor:
    """The mean of every window, one after the other."""
    half = window // 2
    return torch.stack(
        [spikes[max(n - half, 0) : n + half + 1].mean(0, dtype=torch.float32) for n in range(len(spikes))]
    )


def tfp_frame(spikes: Tensor, n: int, window: int, order: int) -> Tensor:
    """One picture, far from the ends of the clip: the means of all windows that it sees, order after order."""
    reach = order * (window // 2)
    seen = spikes[n - reach : n + reach + 1].float()
    for _ in range(order - 1):
        seen = seen.unfold(0, window, 1).mean(-1)
    return seen.mean(0)


def integrate_fire(light: Tensor) -> Tensor:
    """Integrate, compare, subtract; the gradient goes straight through where the light is in the linear range."""
    charge = torch.zeros_like(light[0])
    spikes = []
    for light_t in light:
        charge = charge + light_t
        fired = (charge >= 1).to(light.dtype)
        charge = (charge - fired).detach()
        linear = light_t.clamp(0, 1)
        spikes.append(fired + linear - linear.detach() if light.requires_grad else fired)
    return torch.stack(spikes)


def _pixels(flow: Tensor) -> tuple[Tensor, Tensor]:
    """Columns and rows of all pixels, (H, W) each."""
    columns, rows = (torch.arange(length, device=flow.device) for length in (flow.shape[-1], flow.shape[-2]))
    return torch.meshgrid(columns, rows, indexing="xy")


def grid_sample(image: Tensor, flow: Tensor) -> Tensor:
    """The warp that everyone has: bilinear, from all pixels."""
    height, width = image.shape[-2:]
    x, y = _pixels(flow)
    grid = torch.stack(
        [2 * (x + flow[:, 0]) / max(width - 1, 1) - 1, 2 * (y + flow[:, 1]) / max(height - 1, 1) - 1], dim=-1
    )
    return F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)


def idw_window(features: Tensor, flow: Tensor, mask: Tensor, radius: int) -> Tensor:
    """Inverse distance weighting by search: all pixels of a window around the target, the nearest four known ones."""
    _, channels, height, width = features.shape
    x, y = _pixels(flow)
    reach = torch.arange(-radius, radius + 1, device=flow.device)
    step_y, step_x = (step.reshape(-1, 1, 1) for step in torch.meshgrid(reach, reach, indexing="ij"))
    pictures = []
    for values, (u, v) in zip(features, flow, strict=True):
        target_x, target_y = x + u, y + v
        near_x = target_x.detach().round().clamp(0, width - 1).long() + step_x
        near_y = target_y.detach().round().clamp(0, height - 1).long() + step_y
        inside = (near_x >= 0) & (near_x < width) & (near_y >= 0) & (near_y < height)
        index = near_y.clamp(0, height - 1) * width + near_x.clamp(0, width - 1)
        known = inside & (mask.flatten()[index] != 0)
        square = (near_x - target_x) ** 2 + (near_y - target_y) ** 2
        nearest, which = torch.where(known, square, torch.inf).topk(4, dim=0, largest=False)
        weight = 1 / nearest.clamp(min=1e-12).sqrt()
        weight = weight / weight.sum(0)
        gathered = values.reshape(channels, -1)[:, index.gather(0, which)]
        pictures.append((gathered * weight).sum(1))
    return torch.stack(pictures)


def split_colors(raw: Tensor, pattern: str) -> Tensor:
    """Three streams with one colour each, written pixel by pixel."""
    colours = torch.zeros(3, *raw.shape, dtype=raw.dtype, device=raw.device)
    for i, colour in enumerate(pattern):
        row, column = divmod(i, 2)
        colours["RGB".index(colour), ..., row::2, column::2] = raw[..., row::2, column::2]
    return colours


def linear_motion(to_first: Tensor, to_last: Tensor, times: Sequence[float], scale: int) -> Tensor:
    """Every time on its own: scale the flow, then bring it to the finer grid."""
    first, last = times[0], times[-1]
    middle = (first + last) / 2
    offsets = []
    for t in times:
        flow = (
            to_first * ((t - middle) / (first - middle)) if t < middle else to_last * ((t - middle) / (last - middle))
        )
        offsets.append(scale * F.interpolate(flow, scale_factor=scale, mode="bilinear", align_corners=False))
    return torch.stack(offsets, dim=1)
