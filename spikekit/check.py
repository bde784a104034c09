"""Argument checks shared by all operators, with uniform messages."""

from __future__ import annotations

import operator
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def check_planes(name: str, value: Tensor, ndim: int, shape: str, *, floating: bool = False) -> None:
    """Raise unless ``value`` is a real tensor with at least ``ndim`` dimensions, the last ``ndim`` not empty.

    ``shape`` is the expected shape for the message, such as ``"(*, T, H, W)"``.
    """
    if not isinstance(value, Tensor):
        remedy = "; convert it with torch.from_numpy" if isinstance(value, np.ndarray) else ""
        raise TypeError(f"{name}: expected a tensor of shape {shape}, got {type(value).__name__}{remedy}")
    if value.ndim < ndim or 0 in value.shape[value.ndim - ndim :]:
        raise ValueError(f"{name}: expected a non-empty tensor of shape {shape}, got {tuple(value.shape)}")
    if value.is_complex() or (floating and not value.is_floating_point()):
        kind = "a floating-point" if floating else "a real"
        raise TypeError(f"{name}: expected {kind} tensor, got {value.dtype}")


def check_picture(
    name: str, value: Tensor, shape: str = "(3, H, W)", *, grey: bool = False, floating: bool = True
) -> None:
    """Raise unless ``value`` is a single picture: (3, H, W), or also (H, W) if ``grey``."""
    check_planes(name, value, 2 if grey else 3, shape, floating=floating)
    if value.ndim > 3 or (value.ndim == 3 and value.shape[0] != 3):
        raise ValueError(f"{name}: expected {shape}, got {tuple(value.shape)}")


def check_size(
    name: object, size: Sequence[int], expected: Sequence[int], said: str = "", kind: type[ValueError] = ValueError
) -> None:
    """Raise a ``kind`` unless a size (H, W) is the expected one, which ``said`` explains."""
    if tuple(size) != tuple(expected):
        wanted, got = (f"{height} x {width}" for height, width in (expected, size))
        raise kind(f"{name}: expected {wanted}{said}, got {got}")


def check_dtype(dtype: torch.dtype | None, *others: torch.dtype) -> None:
    """Raise unless ``dtype`` is None, floating, or one of ``others``."""
    known = dtype is None or isinstance(dtype, torch.dtype)
    if not known or not (dtype is None or dtype.is_floating_point or dtype in others):
        raise TypeError(f"dtype: expected a floating-point type{''.join(f' or {o}' for o in others)}, got {dtype!r}")


def check_positive(name: str, value: float) -> None:
    """Raise unless ``value`` is a finite number above zero."""
    try:
        good = bool(0 < value < float("inf"))
    except (TypeError, RuntimeError, ValueError):  # such as a tensor with several elements
        raise TypeError(f"{name}: expected a finite number above 0, got {value!r}") from None
    if not good:
        raise ValueError(f"{name}: expected a finite number above 0, got {value}")


def check_index(name: str, value: int) -> int:
    """Return ``value`` as an int; raise a TypeError unless it is an integer of Python or NumPy."""
    try:
        return operator.index(value)
    except TypeError:
        raise TypeError(f"{name}: expected a whole number, got {value!r}") from None


def check_whole(name: str, value: int) -> int:
    """Return ``value`` as an int; raise a ValueError unless it is a whole number >= 1 and not a bool."""
    if isinstance(value, torch.SymInt):  # a dynamic size of torch.export
        return value
    if not isinstance(value, int) and hasattr(value, "__index__"):  # NumPy's
        value = operator.index(value)
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name}: expected a whole number >= 1, got {value!r}")
    return value


def wide_dtype(*tensors: Tensor) -> torch.dtype:
    """Return the dtype to compute in: float64 if one of the tensors has it, else float32."""
    return torch.float64 if torch.float64 in [tensor.dtype for tensor in tensors] else torch.float32


def default_float(value: Tensor) -> torch.dtype:
    """Return the dtype of ``value`` if it is floating, else torch's default dtype."""
    return value.dtype if value.is_floating_point() else torch.get_default_dtype()
