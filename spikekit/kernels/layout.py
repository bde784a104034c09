"""Allocation and memory layout of results."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor


def new_tensor(shape: tuple[int, ...], dtype: torch.dtype, numpy_new: Callable[..., np.ndarray] = np.empty) -> Tensor:
    """Allocate a CPU tensor by NumPy, which requests huge pages."""
    return torch.from_numpy(numpy_new(shape, f"i{dtype.itemsize}")).view(dtype)


def is_channels_last(values: Tensor) -> bool:
    """Return whether the channels of (B, C, P) are contiguous in memory."""
    return values.stride(1) == 1 and values.stride(2) > 1


def empty_like_layout(values: Tensor, size: int, empty: Callable[[tuple[int, ...]], Tensor] | None = None) -> Tensor:
    """Return an empty tensor (B, C, size) in the dtype of ``values``, channels last if ``values`` are."""
    empty = empty or values.new_empty
    batch, channels, _ = values.shape
    if is_channels_last(values):
        return empty((batch, size, channels)).transpose(1, 2)
    return empty((batch, channels, size))
