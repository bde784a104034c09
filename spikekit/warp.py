"""Warping: sample a picture, or the known pixels of one, where flow points to."""

from __future__ import annotations

import numpy as np
import torch
from kornia.geometry import create_meshgrid
from kornia.geometry.transform import remap
from torch import Tensor, nn
from torch.utils.weak import WeakTensorKeyDictionary

from spikekit.check import check_planes
from spikekit.gather import Gather

_FARTHEST = 2.0**30  # flow beyond it is cut: positions must fit an integer
_CHUNK = 1 << 15  # positions searched at a time: in the cache, and by one thread, without waiting for another


def _check_warp(name: str, image: Tensor, flow: Tensor) -> None:
    check_planes(name, image, 3, "(*, C, H, W)", floating=True)
    check_planes("flow", flow, 3, "(*, 2, H, W)", floating=True)
    if flow.shape[-3] != 2 or flow.shape[-2:] != image.shape[-2:] or flow.shape[:-3] != image.shape[:-3]:
        expected = (*image.shape[:-3], 2, *image.shape[-2:])
        raise ValueError(f"flow: expected {expected} for {name} {tuple(image.shape)}, got {tuple(flow.shape)}")


def flow_warp(image: Tensor, flow: Tensor) -> Tensor:
    r"""Sample an image where flow points to, bilinearly.

    .. math:: O(x, y) = I(x + u(x, y), y + v(x, y))

    Convention:
        Flow in pixels, order (x, y), x right, y down. Pixel centres are at whole numbers; positions outside the image
        are moved to its border. Coordinates are computed in float32 or wider. Built on
        :func:`kornia.geometry.transform.remap`.

    Args:
        image: :math:`(*, C, H, W)`, floating.
        flow: :math:`(*, 2, H, W)`.

    Returns:
        As ``image``.

    Raises:
        TypeError: not floating-point tensors.
        ValueError: sizes that do not fit each other.

    Example:
        >>> image = torch.tensor([[[[0.0, 1.0, 2.0, 3.0]]]])
        >>> flow_warp(image, torch.tensor([1.5, 0.0]).reshape(1, 2, 1, 1).expand(1, 2, 1, 4)).flatten().tolist()
        [1.5, 2.5, 3.0, 3.0]
    """
    _check_warp("image", image, flow)
    height, width = image.shape[-2:]
    wide = torch.promote_types(torch.promote_types(image.dtype, flow.dtype), torch.float32)
    planes = image.reshape(-1, *image.shape[-3:]).to(wide)
    grid = create_meshgrid(height, width, normalized_coordinates=False, device=flow.device, dtype=wide)
    x, y = (grid + flow.reshape(-1, 2, height, width).to(wide).movedim(1, -1)).unbind(-1)
    warped = remap(planes, x, y, mode="bilinear", padding_mode="border", align_corners=True)
    return warped.to(image.dtype).reshape(image.shape)


class FlowWarp(nn.Module):
    r"""See the Convention block on :func:`flow_warp`.

    Shape:
        - Input: image :math:`(*, C, H, W)` and flow :math:`(*, 2, H, W)`
        - Output: :math:`(*, C, H, W)`

    Example:
        >>> FlowWarp()(torch.rand(2, 3, 8, 8), torch.zeros(2, 2, 8, 8)).shape
        torch.Size([2, 3, 8, 8])
    """

    def forward(self, image: Tensor, flow: Tensor) -> Tensor:  # noqa: D102
        return flow_warp(image, flow)


def _nearest_on_axis(known: np.ndarray, length: int, neighbors: int) -> np.ndarray:
    """Positions of the nearest known indices, nearest first, for every interval ((h - 1) / 2, h / 2].

    Between two half-integers the order of whole numbers by distance does not change; at h / 2 itself two may be
    equally far, and the lower one wins. So the order at q depends on ceil(2 q) alone, and beyond the axis it does not
    change any more: 2 * length rows are enough for every q.
    """
    h = np.arange(2 * length)
    # known positions that can be among the nearest: as many to the left of h / 2 as to the right
    start = np.searchsorted(known, h / 2)[:, None] + np.arange(-neighbors, neighbors)
    outside = (start < 0) | (start >= len(known))
    position = known[start.clip(0, len(known) - 1)]
    distance = np.where(outside, np.inf, np.abs(2 * position - h[:, None]))
    order = np.argsort(distance, axis=1, kind="stable")[:, : min(neighbors, len(known))]
    return np.take_along_axis(position, order, axis=1)


_Tables = list[tuple[Tensor, Tensor]]
# By identity: a WeakKeyDictionary would compare tensors with ==.
_tables_of_mask = WeakTensorKeyDictionary()


def _tables(mask: Tensor, neighbors: int) -> _Tables:
    """Write a mask as products of known rows and known columns, and return the (rows, columns) table of each.

    Rows with the same known columns belong together, so that every mask is a union of such products: one for red and
    for blue of a Bayer filter, two for green.
    """
    # inference tensors do not count their changes, so nothing is kept for them
    state = None if mask.is_inference() else (mask._version, neighbors)
    kept_state, tables = _tables_of_mask.get(mask, (None, []))
    if state is not None and state == kept_state:
        return tables
    known = (mask.detach() != 0).cpu().numpy()
    height, width = known.shape
    rows_of_pattern: dict[bytes, list[int]] = {}
    for row, pattern in enumerate(known):
        rows_of_pattern.setdefault(pattern.tobytes(), []).append(row)
    tables = []
    for pattern, rows in rows_of_pattern.items():
        columns = np.flatnonzero(np.frombuffer(pattern, dtype=bool))
        if len(columns):
            axes = (np.array(rows), height), (columns, width)
            lookup = [
                torch.from_numpy(_nearest_on_axis(*axis, neighbors).T.astype(np.int32)).to(mask.device) for axis in axes
            ]
            tables.append((lookup[0], lookup[1]))
    if not tables:
        raise ValueError("mask: expected at least one known pixel, got none")
    if state is not None:
        _tables_of_mask[mask] = (state, tables)
    return tables


def _on_axis(table: Tensor, cell: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
    """Nearest positions on one axis, and their squared distance less that of a common reference: both (k, n)."""
    top = table.shape[1] - 1
    half = (2 * cell + torch.ceil(2 * part).nan_to_num(0).long()).clamp(0, top)
    position = table.index_select(1, half)
    reference = cell.clamp(0, top // 2)
    step = (position - reference.int()).to(part.dtype)
    # (p - q)^2 - (r - q)^2 without squaring what is far away; q = cell + part
    return position, step * (step + 2 * ((reference - cell).to(part.dtype) - part))


@torch.library.custom_op("spikekit::nearest_known", mutates_args=())
def _nearest_known(cell: Tensor, part: Tensor, mask: Tensor, neighbors: int) -> Tensor:
    """Flat indices (N, neighbors, H, W) of the known pixels nearest to cell + part, (N, 2, H, W).

    Nearest first, exact, row-major order among equals; -1 where fewer pixels are known.
    """
    count, _, height, width = cell.shape
    tables = _tables(mask, neighbors)
    nearest = cell.new_full((neighbors, count * height * width), -1)
    x, y = cell.movedim(1, 0).reshape(2, -1)
    x_part, y_part = part.movedim(1, 0).reshape(2, -1)
    size = _CHUNK if x.device.type == "cpu" else 128 * _CHUNK  # elsewhere a launch costs more than the cache saves
    for begin in range(0, x.numel(), size):
        chunk = slice(begin, begin + size)
        best: list[tuple[Tensor, Tensor]] = []
        for rows, columns in tables:
            row, row_distance = _on_axis(rows, y[chunk], y_part[chunk])
            column, column_distance = _on_axis(columns, x[chunk], x_part[chunk])
            for i in range(len(row)):
                for j in range(min(len(column), neighbors // (i + 1))):
                    before = (i + 1) * (j + 1) - 1  # so many pixels of this product are at least as near
                    _insert(best, row_distance[i] + column_distance[j], row[i] * width + column[j], before, neighbors)
        for slot, (_, index) in enumerate(best):
            nearest[slot, chunk] = index
    return nearest.reshape(neighbors, count, height, width).movedim(0, 1).contiguous()


def _insert(best: list[tuple[Tensor, Tensor]], distance: Tensor, index: Tensor, before: int, most: int) -> None:
    """Keep the smallest (distance, index), in order; the new one cannot be among the first ``before``."""
    for slot in range(before, len(best)):
        other, other_index = best[slot]
        closer = (distance < other) | ((distance == other) & (index < other_index))
        best[slot] = torch.where(closer, distance, other), torch.where(closer, index, other_index)
        if slot + 1 < most:
            distance, index = torch.where(closer, other, distance), torch.where(closer, other_index, index)
    if len(best) < most:
        best.append((distance, index))


@_nearest_known.register_fake
def _(cell: Tensor, part: Tensor, mask: Tensor, neighbors: int) -> Tensor:
    return cell.new_empty(cell.shape[0], neighbors, *cell.shape[2:])


def flow_warp_idw(features: Tensor, flow: Tensor, mask: Tensor, *, neighbors: int = 4) -> Tensor:
    r"""Sample features where flow points to, from the nearest known pixels, weighted by inverse distance.

    .. math::
        T(x, y) = \sum_{i=1}^{n} \frac{\phi_i}{\sum_j \phi_j} F(x_i, y_i), \quad
        \phi_i = \frac{1}{\sqrt{(x_m - x_i)^2 + (y_m - y_i)^2}}, \quad (x_m, y_m) = (x, y) + w(x, y)

    Convention:
        Flow in pixels, order (x, y), x right, y down. The neighbours are the exact nearest known pixels of any mask,
        also for positions outside the image; among equally distant ones the first in row-major order wins. Where
        fewer than ``neighbors`` pixels are known, all of them count. A position that hits a known pixel gives that
        pixel. Positions are kept as a whole and a fractional part in float32 or wider, so that they are as exact at
        column 4000 as at column 0, in half precision too.

        Differentiable in the features and in the flow; the neighbours themselves are constants. On a known pixel the
        gradient with respect to the flow, a cone's tip, is 0.

    Args:
        features: :math:`(*, C, H, W)`, floating.
        flow: :math:`(*, 2, H, W)`.
        mask: :math:`(H, W)`; a pixel is known where it is not 0.
        neighbors: how many known pixels to weigh.

    Returns:
        As ``features``.

    Raises:
        TypeError: features or flow are not floating-point tensors.
        ValueError: sizes that do not fit each other, ``neighbors`` below 1, a mask without a known pixel.

    Example:
        >>> features = torch.tensor([[[[1.0, 0.0, 5.0, 0.0]]]])
        >>> known = torch.tensor([[1, 0, 1, 0]])
        >>> flow_warp_idw(features, torch.zeros(1, 2, 1, 4), known).flatten().tolist()
        [1.0, 3.0, 5.0, 4.0]

    Reference:
        Dong et al., CVPR 2024, eq. (9)-(10).
    """
    _check_warp("features", features, flow)
    height, width = features.shape[-2:]
    if not isinstance(mask, Tensor) or mask.shape != features.shape[-2:]:
        got = tuple(mask.shape) if isinstance(mask, Tensor) else type(mask).__name__
        raise ValueError(f"mask: expected {(height, width)} for features {tuple(features.shape)}, got {got}")
    if isinstance(neighbors, bool) or not isinstance(neighbors, int) or neighbors < 1:
        raise ValueError(f"neighbors: expected a whole number >= 1, got {neighbors!r}")
    dtype = torch.promote_types(torch.promote_types(features.dtype, flow.dtype), torch.float32)
    flow = flow.reshape(-1, 2, height, width).to(dtype).clamp(-_FARTHEST, _FARTHEST)
    whole = flow.detach().floor()
    part = flow - whole
    pixel = torch.stack(
        torch.meshgrid(torch.arange(width, device=flow.device), torch.arange(height, device=flow.device), indexing="xy")
    )
    cell = pixel + whole.nan_to_num(0).long()

    nearest = _nearest_known(cell, part.detach(), mask, neighbors)
    exists = nearest >= 0
    nearest = nearest.clamp(min=0)
    row = nearest // width
    dx = (nearest - row * width - cell[:, :1]).to(dtype) - part[:, :1]
    dy = (row - cell[:, 1:]).to(dtype) - part[:, 1:]
    square = dx * dx + dy * dy
    hit = square == 0
    distance = torch.where(hit, 1, square).sqrt() * ~hit
    # 1 / d, relative to the nearest: no overflow next to a known pixel, and a gradient that stays accurate there
    weight = torch.where(exists[:, 1:], distance[:, :1] / torch.where(exists, distance, 1)[:, 1:], 0)
    weight = torch.cat([torch.ones_like(distance[:, :1]), weight], dim=1)
    share = weight / weight.sum(dim=1, keepdim=True)

    values = features.reshape(-1, features.shape[-3], height * width)
    return Gather.apply(values, nearest.flatten(2), share.flatten(2)).reshape(features.shape)


class FlowWarpIdw(nn.Module):
    r"""See the Convention block on :func:`flow_warp_idw`.

    Shape:
        - Input: features :math:`(*, C, H, W)`, flow :math:`(*, 2, H, W)` and mask :math:`(H, W)`
        - Output: :math:`(*, C, H, W)`

    Example:
        >>> FlowWarpIdw()(torch.rand(2, 3, 8, 8), torch.zeros(2, 2, 8, 8), torch.ones(8, 8)).shape
        torch.Size([2, 3, 8, 8])
    """

    def __init__(self, *, neighbors: int = 4) -> None:
        super().__init__()
        self.neighbors = neighbors

    def forward(self, features: Tensor, flow: Tensor, mask: Tensor) -> Tensor:  # noqa: D102
        return flow_warp_idw(features, flow, mask, neighbors=self.neighbors)

    def extra_repr(self) -> str:  # noqa: D102
        return f"neighbors={self.neighbors}"
