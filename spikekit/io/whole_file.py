"""Atomic writing of files."""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from spikekit.arguments import home_path
from spikekit.standard_output import FULL

try:
    import fcntl
except ImportError:  # Windows, where an open file cannot be removed
    fcntl = None

_SIDE_BY_SIDE = 8  # largest number of leftovers of one file that are removed


@contextmanager
def whole_file(path: str | Path, mode: str = "wb", **how: Any) -> Iterator[IO[Any]]:
    """Open a file for atomic writing: it appears under its name when it is complete.

    Convention:
        The data goes to a hidden file beside the target, which is flushed to disk and then renamed. A full disk, an
        error or ``kill -9`` therefore leaves the old file, or none. After an error the hidden file is removed. That of
        a killed process ends in ``.part``, and is removed the next time the same file is written. If several processes
        write the same file, the last one wins.

        The file keeps the mode of the one that it replaces. A symbolic link is replaced and not followed, as folders
        from other people may contain links.

    Args:
        path: the file to write; its folder is created if needed.
        mode: ``"wb"`` or ``"w"``.
        how: further arguments of ``open``, such as ``encoding``.

    Returns:
        A context that yields the open file.

    Raises:
        OSError: the file or its folder cannot be written; the error names the file.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with whole_file(f"{folder}/new/a.txt", "w") as file:
        ...         _ = file.write("all of it")
        ...         early = Path(folder, "new", "a.txt").exists()
        ...     early, Path(folder, "new", "a.txt").read_text()
        (False, 'all of it')
    """
    path = home_path(path)
    if path.is_dir() or (path.exists() and not path.is_symlink() and not path.is_file()):
        number = errno.EISDIR if path.is_dir() else errno.EINVAL
        raise OSError(number, "expected a file, got a folder, a pipe or a device", str(path))
    target = Path(os.path.realpath(path.parent), path.name)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        part, file = _open_part(target, mode, **how)
    except OSError as error:
        number = errno.ENOTDIR if isinstance(error, FileExistsError) else error.errno
        raise OSError(number, os.strerror(number), str(path)) from error
    try:
        yield file
        file.flush()
        os.fsync(file.fileno())
        with suppress(OSError):  # some file systems have no modes
            if target.is_file() and not target.is_symlink():
                os.chmod(part, target.stat().st_mode & 0o7777)
        if fcntl is None:
            file.close()
        os.replace(part, target)
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in FULL and error.filename is None:
            error.filename = str(path)
        with suppress(OSError):
            file.close()
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    file.close()  # only now, as this releases the lock
    flush_folder(target.parent)


def write_whole(path: str | Path, data: bytes | memoryview | str) -> None:
    """Write a file atomically, see :func:`whole_file`; text as UTF-8."""
    how = {"mode": "w", "encoding": "utf-8"} if isinstance(data, str) else {}
    with whole_file(path, **how) as file:
        file.write(data)


def hidden_name(name: str) -> str:
    """Return the stem of a hidden file's name, short enough for an ending within 255 bytes."""
    raw = os.fsencode(name)
    return f".{name}" if len(raw) < 230 else f".{hashlib.sha256(raw).hexdigest()}"


def _open_part(target: Path, mode: str, **how: Any) -> tuple[Path, IO[Any]]:
    """Open and lock a numbered file beside the target, and remove the leftovers of killed processes."""
    hidden = hidden_name(target.name)
    for n in range(_SIDE_BY_SIDE):
        leftover = target.with_name(f"{hidden}.{n}.part")
        with suppress(OSError), open(leftover, "rb") as file:
            if _lock(file):
                leftover.unlink()
    n = 0
    while True:
        part = target.with_name(f"{hidden}.{n}.part")
        with suppress(FileExistsError):
            file = open(part, mode.replace("w", "x"), **how)  # noqa: SIM115 - closed by the caller
            with suppress(OSError):
                if _lock(file) is not False and os.path.samestat(os.fstat(file.fileno()), os.stat(part)):
                    return part, file
            file.close()  # another process removed it as a leftover before it was locked
        n += 1


def _lock(file: IO[Any]) -> bool | None:
    """Lock a file until it is closed; return False if another process holds the lock, None if locks are unsupported."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def flush_folder(folder: Path) -> None:
    """Flush a folder to disk, if the system can, so that a renaming survives a power failure."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
