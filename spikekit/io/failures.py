"""Errors with files, as one line that names the file."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spikekit.arguments import one_line


def no_pipe(path: str | Path) -> Path:
    """Return the path of what is to be read; raise OSError of a pipe or a device, which would be waited for."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # whoever reads it says so
        return Path(path)
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise OSError(errno.EINVAL, "a pipe or a device, expected a file", str(path))
    return Path(path)


@contextmanager
def reading(path: str | Path, kind: type[ValueError], what: str = "", otherwise: str = "{}") -> Iterator[None]:
    """Turn any error while reading a file, or ``what`` of it, into one line; one of its kind passes as it is.

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
    except MemoryError as error:  # also what PyAV says of damaged sizes
        raise kind(f"{path}: {what}takes more memory than there is") from error
    except Exception as error:
        said = one_line(error).removeprefix(f"{path}: ")[:300]
        form = "cannot be read ({})" if isinstance(error, OSError) else otherwise
        raise kind(f"{path}: {what}{form.format(said)}") from error
