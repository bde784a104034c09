"""Compilation of loops by Numba, for modules that are imported only if Numba is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import torch
from numba import njit


def compiled(loop: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop at its first call, and cache it on disk if possible."""
    options = {"nogil": True, "error_model": "numpy"}
    try:
        kept = njit(loop, cache=True, **options)
    except RuntimeError:  # no writable folder for the cache
        return njit(loop, **options)
    save = kept._cache.save_overload

    def save_if_possible(*compilation: Any) -> None:
        with suppress(OSError):  # such as a full disk
            save(*compilation)

    kept._cache.save_overload = save_if_possible
    return kept


def in_threads(loop: Callable[..., Any], jobs: Iterable[tuple[Any, ...]], *, worth: bool = True) -> None:
    """Run a compiled loop for every job, in torch's number of threads if ``worth`` it."""
    threads = torch.get_num_threads()
    if threads == 1 or not worth:
        for job in jobs:
            loop(*job)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda job: loop(*job), jobs):
            pass
