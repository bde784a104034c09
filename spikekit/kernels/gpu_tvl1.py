"""One level of :func:`spikekit.flow.tvl1.tvl1_flow` on a GPU: three launches per round; torch needs about sixty."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from spikekit.kernels.gpu_parts import launch, my_pixels

_BLOCK = 128


@triton.jit
def _warped(image, flow, time, plane, y, x, height, width, inside):
    """Return an image warped by ``time`` times the flow at (x, y), bilinearly, with replicated borders."""
    pixel = y * width + x
    at_x = x + time * tl.load(flow + pixel, mask=inside, other=0.0)
    at_y = y + time * tl.load(flow + plane + pixel, mask=inside, other=0.0)
    at_x = tl.where(at_x > 0, tl.minimum(at_x, width - 1.0), 0.0)  # also for NaN
    at_y = tl.where(at_y > 0, tl.minimum(at_y, height - 1.0), 0.0)
    left = tl.minimum(at_x.to(tl.int32), width - 2)
    top = tl.minimum(at_y.to(tl.int32), height - 2)
    right_share, low_share = at_x - left, at_y - top
    corner = image + top * width + left
    upper_left = tl.load(corner, mask=inside, other=0.0)
    lower_left = tl.load(corner + width, mask=inside, other=0.0)
    upper = upper_left + right_share * (tl.load(corner + 1, mask=inside, other=0.0) - upper_left)
    lower = lower_left + right_share * (tl.load(corner + width + 1, mask=inside, other=0.0) - lower_left)
    return upper + low_share * (lower - upper)


@triton.jit
def _slopes(image, flow, time, plane, y, x, height, width, inside):
    """Return a warped image and its derivatives along both axes."""
    left, right = tl.maximum(x - 1, 0), tl.minimum(x + 1, width - 1)
    above, below = tl.maximum(y - 1, 0), tl.minimum(y + 1, height - 1)
    here = _warped(image, flow, time, plane, y, x, height, width, inside)
    along_x = _warped(image, flow, time, plane, y, right, height, width, inside)
    along_x -= _warped(image, flow, time, plane, y, left, height, width, inside)
    along_y = _warped(image, flow, time, plane, below, x, height, width, inside)
    along_y -= _warped(image, flow, time, plane, above, x, height, width, inside)
    return here, along_x / (right - left).to(tl.float32), along_y / (below - above).to(tl.float32)


@triton.jit(do_not_specialize=["height", "width"])
def _linearise_kernel(pictures, times, flow, slope, rest, height, width, block: tl.constexpr):
    """Linearise the difference of two warped pictures in the flow: slope, and value at zero flow."""
    plane = height * width
    clip, pixel, inside = my_pixels(plane, block)
    pixel = pixel.to(tl.int32)
    y, x = pixel // width, pixel % width
    pictures += 2 * clip * plane
    flow += 2 * clip * plane
    early, late = tl.load(times + 2 * clip), tl.load(times + 2 * clip + 1)
    first, first_x, first_y = _slopes(pictures, flow, early, plane, y, x, height, width, inside)
    second, second_x, second_y = _slopes(pictures + plane, flow, late, plane, y, x, height, width, inside)
    along_x, along_y = late * second_x - early * first_x, late * second_y - early * first_y
    slope += 2 * clip * plane + pixel
    tl.store(slope, along_x, mask=inside)
    tl.store(slope + plane, along_y, mask=inside)
    moved = along_x * tl.load(flow + pixel, mask=inside, other=0.0)
    moved += along_y * tl.load(flow + plane + pixel, mask=inside, other=0.0)
    tl.store(rest + clip * plane + pixel, second - first - moved, mask=inside)


@triton.jit
def _primal(near, dual, plane, y, x, width, inside):
    """Return the flow at (x, y) from the dual variable."""
    pixel = y * width + x
    flow = tl.load(near + pixel, mask=inside, other=0.0)
    flow += tl.load(dual + pixel, mask=inside, other=0.0)
    flow -= tl.load(dual + pixel - 1, mask=inside & (x > 0), other=0.0)
    flow += tl.load(dual + plane + pixel, mask=inside, other=0.0)
    return flow - tl.load(dual + plane + pixel - width, mask=inside & (y > 0), other=0.0)


@triton.jit(do_not_specialize=["height", "width"])
def _follow_kernel(near, dual, flow, slope, rest, limit, height, width, follow: tl.constexpr, block: tl.constexpr):
    """Compute the smooth flow; with ``follow``, move it along the slope, at most by the limit, to the next ``near``."""
    plane = height * width
    clip, pixel, inside = my_pixels(plane, block)
    pixel = pixel.to(tl.int32)
    y, x = pixel // width, pixel % width
    near += 2 * clip * plane
    dual += 4 * clip * plane
    flow_x = _primal(near, dual, plane, y, x, width, inside)
    flow_y = _primal(near + plane, dual + 2 * plane, plane, y, x, width, inside)
    if not follow:
        flow += 2 * clip * plane + pixel
        tl.store(flow, flow_x, mask=inside)
        tl.store(flow + plane, flow_y, mask=inside)
        return
    slope += 2 * clip * plane + pixel
    along_x, along_y = tl.load(slope, mask=inside, other=0.0), tl.load(slope + plane, mask=inside, other=0.0)
    differs = tl.load(rest + clip * plane + pixel, mask=inside, other=0.0) + along_x * flow_x + along_y * flow_y
    most = tl.load(limit + clip * plane + pixel, mask=inside, other=0.0)
    way = tl.minimum(tl.maximum(-differs / (along_x * along_x + along_y * along_y + 1e-30), -most), most)
    # each program writes only the elements of near that it has read
    tl.store(near + pixel, flow_x + way * along_x, mask=inside)
    tl.store(near + plane + pixel, flow_y + way * along_y, mask=inside)


@triton.jit(do_not_specialize=["height", "width"])
def _smooth_kernel(near, dual, new, height, width, step, damping, block: tl.constexpr):
    """Take one step of total-variation denoising of ``near`` (B, 2, H, W), in the dual variable (B, 2, 2, H, W)."""
    plane = height * width
    component, pixel, inside = my_pixels(plane, block)
    pixel = pixel.to(tl.int32)
    y, x = pixel // width, pixel % width
    near += component * plane
    dual += 2 * component * plane
    new += 2 * component * plane + pixel
    here = _primal(near, dual, plane, y, x, width, inside)
    right = _primal(near, dual, plane, y, x + 1, width, inside & (x + 1 < width))
    below = _primal(near, dual, plane, y + 1, x, width, inside & (y + 1 < height))
    to_right = tl.where(x + 1 < width, right - here, 0.0)
    down = tl.where(y + 1 < height, below - here, 0.0)
    share = 1 / (1 + damping * tl.sqrt(to_right * to_right + down * down))
    dual_x = tl.load(dual + pixel, mask=inside, other=0.0)
    dual_y = tl.load(dual + plane + pixel, mask=inside, other=0.0)
    tl.store(new, (dual_x + step * to_right) * share, mask=inside)
    tl.store(new + plane, (dual_y + step * down) * share, mask=inside)


def tvl1_level(
    pictures: Tensor, times: Tensor, limit: Tensor, flow: Tensor, warps: int,
    rounds: int, smoothings: int, step: float, damping: float,
) -> Tensor:  # fmt: skip
    """Return the flow (B, 2, H, W) of pictures (B, 2, H, W), float32, like :func:`spikekit.flow.tvl1.refine`."""
    clips, _, height, width = pictures.shape
    pictures, times, limit = pictures.contiguous(), times.to(pictures).contiguous(), limit.contiguous()
    near = flow.clone(memory_format=torch.contiguous_format)
    slope, rest = torch.empty_like(flow), torch.empty_like(limit)
    flow = near.clone()
    duals = [flow.new_zeros(clips, 2, 2, height, width) for _ in range(2)]
    blocks = triton.cdiv(height * width, _BLOCK) * clips
    size = height, width
    for _ in range(warps):
        launch(_linearise_kernel, blocks, pictures, times, flow, slope, rest, *size, block=_BLOCK)
        # near is the flow to which the dual variable is added
        for _ in range(rounds):
            launch(_follow_kernel, blocks, near, duals[0], flow, slope, rest, limit, *size, follow=True, block=_BLOCK)
            for _ in range(smoothings):
                launch(_smooth_kernel, 2 * blocks, near, *duals, *size, step, damping, block=_BLOCK)
                duals.reverse()
        launch(_follow_kernel, blocks, near, duals[0], flow, slope, rest, limit, *size, follow=False, block=_BLOCK)
    return flow
