"""Lazy import of modules that need Numba."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

NUMBA = find_spec("numba") is not None


def import_loops(module: str) -> Any:
    """Import a module with compiled loops; return None if Numba is missing or does not work."""
    try:
        return import_module(module) if NUMBA else None
    except ImportError:  # incompatible with the installed NumPy
        return None
