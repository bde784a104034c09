"""Silence libraries that print about the files they read; real problems are raised."""

from __future__ import annotations

import logging
import os
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class _Silence:
    """Warnings are off while anybody is inside: those of :mod:`warnings` are a process's, not a thread's."""

    def __init__(self) -> None:
        self.lock, self.inside = threading.Lock(), 0

    def enter(self) -> None:
        with self.lock:
            if not self.inside:
                self.before = warnings.catch_warnings()
                self.before.__enter__()
                warnings.simplefilter("ignore")
            self.inside += 1

    def leave(self) -> None:
        with self.lock:
            self.inside -= 1
            if not self.inside:
                self.before.__exit__(None, None, None)


_silence = _Silence()
if hasattr(os, "register_at_fork"):  # another thread of the parent may have held the lock
    os.register_at_fork(after_in_child=lambda: setattr(_silence, "lock", threading.Lock()))


@contextmanager
def quiet() -> Iterator[None]:
    """Keep warnings and log lines about a file from stderr.

    Example:
        >>> with quiet():
        ...     warnings.warn("Corrupt EXIF data")
    """
    log = logging.getLogger("tifffile")
    if not log.handlers:
        log.addHandler(logging.NullHandler())  # an application that logs still gets its lines
    _silence.enter()
    try:
        yield
    finally:
        _silence.leave()
