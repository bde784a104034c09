"""File errors as one line that names the file."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spikekit.arguments import one_line


def no_pipe(path: str | Path) -> Path:
    """Return the path of a file to read; raise OSError for a pipe or a device, which could block."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # reading it will raise
        return Path(path)
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise OSError(errno.EINVAL, "expected a file, got a pipe or a device", str(path))
    return Path(path)


@contextmanager
def reading(path: str | Path, kind: type[ValueError], what: str = "", otherwise: str = "{}") -> Iterator[None]:
    """Convert any error while reading a file, or its part ``what``, to a one-line ``kind``; errors of ``kind`` pass.

    Example:
        >>> with reading("clip.npz", ValueError, otherwise="damaged ({})"):
        ...     raise KeyError("spk")
        Traceback (most recent call last):
        ValueError: clip.npz: damaged ('spk')
    """
    try:
        yield
    except kind:
        raise
    except MemoryError as error:  # PyAV raises it for damaged sizes, too
        raise kind(f"{path}: {what}does not fit into memory") from error
    except Exception as error:
        said = one_line(error).removeprefix(f"{path}: ")[:300]
        form = "cannot be read ({})" if isinstance(error, OSError) else otherwise
        raise kind(f"{path}: {what}{form.format(said)}") from error
