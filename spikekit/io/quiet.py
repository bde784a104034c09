"""Silence the warnings of libraries about the files they read; errors are still raised."""

from __future__ import annotations

import logging
import os
import threading
import warnings

# applications that configure logging still get the records
logging.getLogger("tifffile").addHandler(logging.NullHandler())


class _Quiet:
    """Context that disables warnings while at least one thread is inside; their filters belong to the process."""

    def __init__(self) -> None:
        self.lock, self.inside = threading.Lock(), 0

    def __enter__(self) -> None:
        with self.lock:
            if not self.inside:
                self.before = warnings.catch_warnings()
                self.before.__enter__()
                warnings.simplefilter("ignore")
            self.inside += 1

    def __exit__(self, *_: object) -> None:
        with self.lock:
            self.inside -= 1
            if not self.inside:
                self.before.__exit__(None, None, None)


_quiet = _Quiet()
if hasattr(os, "register_at_fork"):  # another thread of the parent may have held the lock
    os.register_at_fork(after_in_child=lambda: setattr(_quiet, "lock", threading.Lock()))


def quiet() -> _Quiet:
    """Return a context that suppresses warnings and log lines about a file.

    Example:
        >>> with quiet():
        ...     warnings.warn("Corrupt EXIF data")
    """
    return _quiet
