"""Search for the nearest known pixels on a CPU, compiled by Numba."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from spikekit.kernels.compiled import compiled, in_threads

_WORTH_THREADS = 1 << 14  # positions


@compiled
def _search(flow, rows, columns, height, width, begin, end, index, weight):
    """Compute index and weight (K, H W) from flow (2, H W), for the positions ``begin`` to ``end`` of an image.

    ``rows`` (P, 2 H, k) and ``columns`` (P, 2 W, k) hold the nearest known rows and columns of every half pixel,
    nearest first, padded by -1.
    """
    neighbors = len(index)
    best, distances = np.empty(neighbors, np.int64), np.empty(neighbors)
    along_x = np.empty(columns.shape[2])
    for n in range(begin, end):
        y, x = n // width, n % width
        moved_x, moved_y = np.float64(flow[0, n]), np.float64(flow[1, n])
        whole_x, whole_y = np.rint(moved_x), np.rint(moved_y)
        part_x, part_y = moved_x - whole_x, moved_y - whole_y
        cell_x, cell_y = np.int64(whole_x) + x, np.int64(whole_y) + y
        half_x = min(max(2 * cell_x + np.int64(np.ceil(2 * part_x)), 0), 2 * width - 1)
        half_y = min(max(2 * cell_y + np.int64(np.ceil(2 * part_y)), 0), 2 * height - 1)
        reference_x, reference_y = min(max(cell_x, 0), width - 1), min(max(cell_y, 0), height - 1)
        away_x, away_y = (reference_x - cell_x) - part_x, (reference_y - cell_y) - part_y
        count = 0
        for p in range(len(rows)):
            # (p - q)^2 - (r - q)^2 without squaring large numbers
            for j in range(columns.shape[2]):
                step = np.float64(columns[p, half_x, j] - reference_x)
                along_x[j] = step * (step + 2 * away_x)
            for i in range(rows.shape[2]):
                row = rows[p, half_y, i]
                if row < 0:
                    break
                step = np.float64(row - reference_y)
                along_y = step * (step + 2 * away_y)
                for j in range(min(columns.shape[2], neighbors // (i + 1))):  # the others are further away
                    column = columns[p, half_x, j]
                    distance = along_y + along_x[j]
                    full = count == neighbors
                    if column < 0 or (full and distance > distances[count - 1]):
                        break
                    flat = np.int64(row) * width + column
                    if full and distance == distances[count - 1] and flat > best[count - 1]:
                        continue
                    slot = count - 1 if full else count
                    while slot and (
                        distance < distances[slot - 1] or (distance == distances[slot - 1] and flat < best[slot - 1])
                    ):
                        distances[slot], best[slot] = distances[slot - 1], best[slot - 1]
                        slot -= 1
                    distances[slot], best[slot] = distance, flat
                    count += not full
        total = 1.0
        for k in range(neighbors):
            flat = best[k] if k < count else best[0]
            row = flat // width
            dx, dy = (flat - row * width - cell_x) - part_x, (row - cell_y) - part_y
            distances[k] = np.sqrt(dx * dx + dy * dy)
            index[k, n] = flat
        shortest = distances[0]
        for k in range(1, count):
            # relative to the nearest: no overflow near a known pixel; on it the other weights are 0
            distances[k] = shortest / distances[k]
            total += distances[k]
        weight[0, n] = 1 / total
        for k in range(1, neighbors):
            weight[k, n] = distances[k] / total if k < count else 0.0


def nearest_known(flow: Tensor, products: list[tuple[Tensor, Tensor]], neighbors: int) -> tuple[Tensor, Tensor]:
    """Return indices and weights, (N, K, H W), like the operator of this name; for ``products`` see `products_of`."""
    count, _, height, width = flow.shape
    plane = height * width
    stacked = (pad_sequence(list(axis), True, -1) for axis in zip(*products, strict=True))
    rows, columns = (tables.transpose(1, 2).contiguous().numpy() for tables in stacked)
    index = np.empty((count, neighbors, plane), np.int64)
    weight = np.empty((count, neighbors, plane), np.float64 if flow.dtype is torch.float64 else np.float32)
    moved = flow.detach().contiguous().flatten(2).numpy()

    def jobs() -> Iterator[tuple[Any, ...]]:
        size = -(-plane // torch.get_num_threads())
        for n in range(count):
            for begin in range(0, plane, size):
                end = min(begin + size, plane)
                yield moved[n], rows, columns, height, width, begin, end, index[n], weight[n]

    in_threads(_search, jobs(), worth=count * plane >= _WORTH_THREADS)
    return torch.from_numpy(index), torch.from_numpy(weight)
