"""Lazy import of the modules that Numba compiles, where Numba is installed."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

NUMBA = find_spec("numba") is not None


def import_loops(module: str) -> Any:
    """Return a module whose loops are :func:`spikekit.kernels.compiled.compiled`; None without a Numba that works."""
    try:
        return import_module(module) if NUMBA else None
    except ImportError:  # installed, but not made for the NumPy that is
        return None
