r"""The temporal pixel search of eq. (9)-(10) by table look-up, one sensor pixel at a time.

One flow vector is used per sensor pixel, called a *site*, rounded to ``1 / STEPS`` pixel. The s x s temporal pixels of
a site, which bilinear upsampling and :func:`spikekit.flow_warp_idw` would compute, are then linear in a few features
around the position that the flow points to. Their weights depend only on the position in the Bayer cell, on the rounded
fraction of the flow and, near a border, on the distance to it. They are looked up in a table:

.. math:: z_{s y + j,\, s x + i} = \sum_k w_{c k}^{i j} \, x_{b + o_{c k}}, \qquad
    b = \lfloor (x, y) + \text{flow} \rfloor

where c is the class of the position, o are offsets and w weights. Classes near a border have half the resolution of the
rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.compiler import is_exporting

from spikekit.check import wide_dtype
from spikekit.color.cfa import bayer_mask
from spikekit.kernels import compiler_kept_out, custom_operator, gpu_kernel, import_loops, register_kernel
from spikekit.warp.neighbors import finite, products_of, search_and_weigh

STEPS = 32  #: positions per sensor pixel and axis that flow is rounded to
SMALLEST = 12  #: smallest side of a sensor, in pixels, on which the borders have separate classes
_SIDE = 16  # side of the sensor on which the table is computed
_AROUND = 4, 6  # radius, in sensor pixels, that contains the known ones; the second if scale is 1
_LEAST = 1e-7  # smallest weight that is kept


@dataclass(frozen=True, eq=False)
class SiteTable:
    """Weights of the temporal pixels of a site, for one colour of a sensor.

    Args:
        scale: temporal pixels along each side of a site, s.
        low: smallest offset of a feature from the base, for sites away from the borders.
        high: largest offset.
        most: largest number of features of a class.
        start: (C + 1,), int32: first feature of every class.
        offset: (n, 2), int32: offsets (y, x) from the base.
        weight: (n, s^2), float32.
    """

    scale: int
    low: int
    high: int
    most: int
    start: Tensor
    offset: Tensor
    weight: Tensor

    @property
    def places(self) -> int:
        """Number of places on an axis: two inside, for even and odd pixels, and those near the borders."""
        return 4 - self.low + self.high

    def place(self, base: Tensor, length: int) -> Tensor:
        """Classify positions -1 ... ``length`` on an axis; 0 and 1 are away from the borders."""
        place = torch.where(base < -self.low, base + 3, base % 2)
        return torch.where(base + self.high >= length, 3 - self.low + length - base, place)

    def classes(self, y: Tensor, x: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return rows and columns of the bases, and the classes, of int32 positions from -1 to ``length``, in steps."""
        rows, columns = y // STEPS, x // STEPS
        down, right = y - STEPS * rows, x - STEPS * columns
        i, j = self.place(rows, height), self.place(columns, width)
        inside = ((2 * i + j) * STEPS + down) * STEPS + right
        half = STEPS // 2
        border = 4 * STEPS**2 + ((i * self.places + j) * half + down // 2) * half + right // 2
        return rows, columns, torch.where((i < 2) & (j < 2), inside, border)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """Arguments of the kernels."""
        return self.start, self.offset, self.weight, self.scale, self.low, self.high, self.most, STEPS

    def to(self, device: torch.device) -> SiteTable:
        """Return the table on a device."""
        parts = {name: getattr(self, name).to(device) for name in ("start", "offset", "weight")}
        return replace(self, **parts)


def _steps_to(moved: Tensor, length: int, axis: int) -> Tensor:
    """Return the rounded target of each site, int32 (B, T, H, W), in steps, clamped to one site outside the sensor."""
    at = torch.arange(length, device=moved.device, dtype=torch.int32) * STEPS  # bfloat16 of an engine would round it
    at = at.unsqueeze(-1) if axis == -2 else at
    steps = (moved.clamp(-2 * length, 2 * length) * STEPS).round().int()
    return (steps + at).clamp(-STEPS, STEPS * length)


@compiler_kept_out  # torch.compile cannot trace it, and would ignore the cache
@lru_cache(maxsize=24)
def site_table(
    pattern: str,
    color: int,
    scale: int,
    odd: tuple[bool, bool],
    device: torch.device,
    neighbors: int = 4,
    sparse: bool = False,
) -> SiteTable:
    """Return the table of one colour, cached, that weights at most 4 ``neighbors``, the known temporal pixels.

    It depends on whether height and width of the sensor are ``odd``, which changes the phase at the far border. If the
    features are ``sparse``, zero at pixels of other colours, the enlarged ones are renormalised.
    """
    if device.type == "cpu":
        return apart(_make_table, pattern, color, scale, odd, neighbors, sparse)
    return site_table(pattern, color, scale, odd, torch.device("cpu"), neighbors, sparse).to(device)


def apart(make: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a thread of its own, where PyTorch is in none of its modes, neither inference nor export."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(make, *arguments).result()


def _make_table(
    pattern: str, color: int, scale: int, odd: tuple[bool, bool], neighbors: int, sparse: bool
) -> SiteTable:
    size = _SIDE + odd[0], _SIDE + odd[1]
    mask = bayer_mask(*size, pattern, scale=scale, device="cpu", dtype=torch.bool)[color]
    gain = torch.ones(mask.shape, dtype=torch.float64, device="cpu")
    if sparse and scale > 1:
        known = mask[None, None, ::scale, ::scale].double()
        gain /= F.interpolate(known, scale_factor=scale, mode="bilinear").squeeze().where(mask, 1)
    inside, step = [_SIDE // 2, _SIDE // 2 + 1], torch.arange(STEPS, device="cpu")
    ends = step[[0, 1, STEPS // 2 - 1, STEPS // 2, STEPS // 2 + 1, -2, -1]]
    # offsets of sites inside on one axis and near a border on the other, where known pixels lie further apart
    near = [[*inside, -1, 0, 1, length, length - 1, length - 2] for length in size]
    wide = _weights(mask, gain, neighbors, scale, near[0], inside, ends)[1][:, 1]
    high_ones = _weights(mask, gain, neighbors, scale, inside, near[1], ends)[1][:, 0]
    low, high = int(min(wide.min(), high_ones.min())), int(max(wide.max(), high_ones.max()))
    axes = [[*inside, *range(-1, -low), *range(length, length - high - 1, -1)] for length in size]
    # row by row: fits in the cache
    found = [_weights(mask, gain, neighbors, scale, [row], inside, step) for row in inside]
    found += [_weights(mask, gain, neighbors, scale, [row], axes[1], step[::2]) for row in axes[0]]
    count, offset, weight = (torch.cat(parts) for parts in zip(*found, strict=True))
    start = F.pad(count.cumsum(0), (1, 0))
    return SiteTable(scale, low, high, int(count.max()), start.int(), offset.int(), weight)


def _weights(
    mask: Tensor, gain: Tensor, neighbors: int, scale: int, rows: list[int], columns: list[int], steps: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the weights for bases in I rows and J columns, at S x S fractions ``steps``.

    ``mask`` and ``gain`` are those of all temporal pixels, (s H, s W). Returned are, for the I J S^2 classes, the
    number of features, (classes,), their offsets, (n, 2), and weights, (n, s^2).
    """
    height, width = (length // scale for length in mask.shape)
    # distinct targets of the temporal pixels of a site at all fractions, in steps of a temporal pixel
    pixel = torch.arange(scale, device="cpu")
    moved, which = (steps[:, None] * scale + STEPS * pixel).unique(return_inverse=True)
    part = torch.arange(len(moved), device="cpu")
    axes = torch.tensor(rows, device="cpu"), part, torch.tensor(columns, device="cpu"), part
    base_y, down, base_x, right = (part.flatten() for part in torch.meshgrid(*axes, indexing="ij"))
    y, x = (scale * base + moved[part] / STEPS for base, part in ((base_y, down), (base_x, right)))
    at = torch.stack([x.clamp(-0.5, scale * width - 0.5), y.clamp(-0.5, scale * height - 0.5)]).double()
    cell = at.round()
    index, weight = search_and_weigh(products_of(mask, neighbors), neighbors, scale * width, cell.long(), at - cell)
    weight = weight * gain.flatten()[index]
    around = _AROUND[scale == 1]
    side = 2 * around + 1
    dense = torch.zeros(len(y), side * side, dtype=torch.float32, device="cpu")
    # a known temporal pixel is a bilinear mixture of features, as in torch.nn.functional.interpolate
    for i, weight_y in _mixture(index // (scale * width), scale, height):
        for j, weight_x in _mixture(index % (scale * width), scale, width):
            amount = weight * weight_y * weight_x
            tap = (i - base_y + around) * side + j - base_x + around
            # features of weight 0 may lie outside
            dense.scatter_add_(1, tap.where(amount != 0, 0).T, amount.float().T)
    dense = dense.reshape(len(rows), len(moved), len(columns), len(moved), -1)
    used = dense > _LEAST  # by one of the temporal pixels of the site
    used = reduce(torch.logical_or, (used.index_select(1, part) for part in which.T))
    used = reduce(torch.logical_or, (used.index_select(3, part) for part in which.T)).transpose(1, 2)
    row, column, down, right, tap = used.nonzero(as_tuple=True)
    first = ((row * len(moved) + which.T[:, down]) * len(columns) + column) * len(moved) * side**2 + tap
    weight = dense.take(first.unsqueeze(1) + which.T[:, right] * side**2)
    offset = torch.stack([tap // side - around, tap % side - around], dim=1)
    return used.sum(dim=-1).flatten(), offset, weight.flatten(0, 1).T.contiguous()


def _mixture(pixel: Tensor, scale: int, length: int) -> list[tuple[Tensor, Tensor]]:
    """Return the two features on an axis that a temporal pixel is interpolated from, and their weights."""
    at = ((pixel + 0.5) / scale - 0.5).clamp(0, length - 1)
    first = at.floor()
    share = at - first
    return [(first.long(), 1 - share), ((first.long() + 1).clamp(max=length - 1), share)]


def _find(flow: Tensor, shares: Tensor, table: SiteTable) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows and columns of the bases, and the classes, of all sites and time points, (B, T, H, W)."""
    height, width = flow.shape[-2:]
    moved = torch.einsum("tk,bkchw->btchw", shares.to(flow.dtype), flow)
    return table.classes(_steps_to(moved[:, :, 1], height, -2), _steps_to(moved[:, :, 0], width, -1), height, width)


def _taps(flow: Tensor, shares: Tensor, table: SiteTable) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield, feature by feature, the indices for all sites, (B T, H W), and the weights, (B T, H W, s^2)."""
    width = flow.shape[-1]
    rows, columns, classes = (part.flatten(0, 1) for part in _find(flow, shares, table))
    begin, end = table.start[classes].long(), table.start[classes + 1].long()
    for k in range(table.most):
        tap = (begin + k).minimum(end - 1)
        away = table.offset[tap].long()
        index = (rows + away[..., 0]) * width + columns + away[..., 1]
        yield index.flatten(1), (table.weight[tap] * (begin + k < end).unsqueeze(-1)).flatten(1, 2)


@compiler_kept_out
@lru_cache(maxsize=24)
def _rows(table: SiteTable) -> tuple[Tensor, Tensor, Tensor]:
    """Return the distinct classes of a table: number of each class, offsets (R, K, 2) and weights (R, K, s^2)."""

    def make() -> tuple[Tensor, Tensor, Tensor]:
        begin, end = table.start[:-1, None].long(), table.start[1:, None].long()
        tap = begin + torch.arange(table.most, device=begin.device)
        weight = table.weight[tap.minimum(end - 1)] * (tap < end).unsqueeze(-1)
        offset = table.offset[tap.minimum(end - 1)]
        both = torch.cat([offset, weight.view(torch.int32)], dim=2)
        rows, which = both.flatten(1).unique(dim=0, return_inverse=True)
        offset, weight = rows.unflatten(1, both.shape[1:]).split([2, table.scale**2], dim=2)
        return which.int(), offset, weight.contiguous().view(torch.float32)

    return apart(make)


def _search_in_graph(features: Tensor, flow: Tensor, shares: Tensor, table: SiteTable) -> Tensor:
    """Compute :func:`search_sites` in operations that exported formats have, for any size."""
    batch, times, channels, height, width = features.shape
    which, offset, weight = _rows(table)
    rows, columns, classes = _find(flow, shares, table)
    base = torch.arange(batch, dtype=torch.int32, device=flow.device).reshape(-1, 1, 1, 1) * height + rows
    base = (base * width + columns).movedim(1, 0).flatten(1).unsqueeze(-1)
    step = offset[..., 0] * width + offset[..., 1]
    found = which.index_select(0, classes.movedim(1, 0).flatten()).unflatten(0, base.shape[:2])
    pixels = features.permute(1, 0, 3, 4, 2).reshape(times, -1, channels)  # the features of a pixel are copied at once
    result = []
    # one time point at a time: every site has a matrix of its own
    for part, first, row in zip(pixels.unbind(0), base, found, strict=True):
        index = first + step.index_select(0, row)
        near = part.index_select(0, index.flatten()).unflatten(0, index.shape)
        near = near.mT if channels > 1 else near.flatten(1).unsqueeze(1)  # engines multiply rows faster than columns
        result.append((near @ weight.index_select(0, row).to(part.dtype)).flatten(1))
    return torch.cat(result, dim=1).reshape(batch, height, width, -1).movedim(-1, 1)


def _search_sites(
    features: Tensor, flow: Tensor, shares: Tensor, start: Tensor, offset: Tensor, weight: Tensor,
    scale: int, low: int, high: int, most: int, steps: int,
) -> Tensor:  # fmt: skip
    """Compute :func:`search_sites` in plain torch; kernels take the same arguments."""
    batch, *_, height, width = features.shape
    table = SiteTable(scale, low, high, most, start, offset, weight)
    planes = features.flatten(0, 1).flatten(2)
    result = planes.new_zeros(*planes.shape[:2], scale**2, height * width, dtype=wide_dtype(features))
    for index, weights in _taps(flow, shares, table):
        value = planes.gather(2, index.unsqueeze(1).expand_as(planes))
        result += value.unsqueeze(2) * weights.mT.unsqueeze(1).to(result.dtype)
    result = result.reshape(batch, -1, height, width).to(features.dtype)
    return result.contiguous(memory_format=torch.channels_last)


def _spread_sites(
    grad: Tensor, flow: Tensor, shares: Tensor, start: Tensor, offset: Tensor, weight: Tensor,
    scale: int, low: int, high: int, most: int, steps: int,
) -> Tensor:  # fmt: skip
    """Return its derivative in the features, (B, T F s^2, H, W) to (B, T, F, H, W), float32 or wider."""
    height, width = grad.shape[-2:]
    times = len(shares)
    table = SiteTable(scale, low, high, most, start, offset, weight)
    rows = grad.to(wide_dtype(grad)).unflatten(1, (times, -1, scale**2)).flatten(0, 1).flatten(3)
    result = rows.new_zeros(rows.shape[0], rows.shape[1], height * width)
    for index, weights in _taps(flow, shares, table):
        amount = (rows * weights.mT.unsqueeze(1)).sum(dim=2)
        result.scatter_add_(2, index.unsqueeze(1).expand_as(amount), amount)
    return result.reshape(-1, times, rows.shape[1], height, width)


def _empty_sites(features: Tensor, *others: Any) -> Tensor:
    batch, times, channels, height, width = features.shape
    shape = batch, times * channels * others[5] ** 2, height, width
    return features.new_empty(shape).contiguous(memory_format=torch.channels_last)


def _empty_features(grad: Tensor, *others: Any) -> Tensor:
    batch, channels, height, width = grad.shape
    times = len(others[1])
    return grad.new_empty(batch, times, channels // times // others[5] ** 2, height, width, dtype=wide_dtype(grad))


def _operator(plain: Callable[..., Tensor], fake: Callable[..., Tensor]) -> Any:
    name = plain.__name__.removeprefix("_")
    op = custom_operator(name, plain, fake)

    @register_kernel(op, "cpu")
    def _(first: Tensor, *others: Any) -> Tensor:
        loops = import_loops("spikekit.kernels.cpu_sites")
        compiled = loops is not None and first.dtype in (torch.float32, torch.bfloat16)
        return (getattr(loops, name) if compiled else plain)(first, *others)

    @register_kernel(op, "cuda")
    def _(first: Tensor, *others: Any) -> Tensor:
        return (plain if first.dtype is torch.float64 else gpu_kernel(name))(first, *others)

    return op


_gather = _operator(_search_sites, _empty_sites)
_scatter = _operator(_spread_sites, _empty_features)


class _SearchSites(torch.autograd.Function):
    @staticmethod
    def forward(features: Tensor, flow: Tensor, shares: Tensor, table: SiteTable) -> Tensor:
        return _gather(features, flow, shares, *table.arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:3])
        ctx.table, ctx.dtype = inputs[3], inputs[0].dtype

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        return _scatter(grad, *ctx.saved_tensors, *ctx.table.arguments).to(ctx.dtype), None, None, None


def search_sites(features: Tensor, flow: Tensor, shares: Tensor, table: SiteTable) -> Tensor:
    """Return the temporal pixels of all sites and time points as channels (B, T F s^2, H, W), channels last.

    Features (B, T, F, H, W) have at least :data:`SMALLEST` rows and columns; the result is differentiable in them only.
    The flow (B, 2, 2, H, W) is that from the middle to the first and the last time point, in sensor pixels; ``shares``
    (T, 2), float32, are factors of both for the motion to every time point.
    """
    flow = finite(flow.detach().float())
    return (_search_in_graph if is_exporting() else _SearchSites.apply)(features, flow, shares, table)
