"""Loops that Numba compiles, for the modules that are imported only where there is one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import torch
from numba import njit


def compiled(loop: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop when it is first called, and keep it for the next process where that is possible."""
    options = {"nogil": True, "error_model": "numpy"}
    try:
        kept = njit(loop, cache=True, **options)
    except RuntimeError:  # no folder for the cache that can be written to
        return njit(loop, **options)
    save = kept._cache.save_overload

    def save_if_possible(*compilation: Any) -> None:
        with suppress(OSError):  # such as a full disk
            save(*compilation)

    kept._cache.save_overload = save_if_possible
    return kept


def in_threads(loop: Callable[..., Any], jobs: Iterable[tuple[Any, ...]], *, worth: bool = True) -> None:
    """Run a compiled loop for every job, in as many threads as torch has where that is worth it."""
    threads = torch.get_num_threads()
    if threads == 1 or not worth:
        for job in jobs:
            loop(*job)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda job: loop(*job), jobs):
            pass
