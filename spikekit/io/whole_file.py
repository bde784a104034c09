"""Files that are written whole or not at all."""

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
except ImportError:  # Windows, which removes no file that is open
    fcntl = None

_SIDE_BY_SIDE = 8  # writers of one file whose leftovers are found


@contextmanager
def whole_file(path: str | Path, mode: str = "wb", **how: Any) -> Iterator[IO[Any]]:
    """Open a file for writing that appears under its name when it is complete, or not at all.

    Convention:
        What is written goes to a hidden file beside the target, which is flushed to the disk and then takes the
        target's place by one renaming. So a full disk, an error or ``kill -9`` leaves the file that was there before,
        or none. The hidden file is removed where the writing fails; that of a killed process ends in ``.part``, and the
        next writing of the same name removes it. Two processes that write the same name do not disturb each other: the
        last one wins.

        The file keeps the mode of the one that it replaces. A link of that name is replaced, and what it points at
        stays as it is: a folder from a stranger may have links in it. A device, such as ``/dev/stdout``, is written
        directly, and so is a pipe that somebody reads.

    Args:
        path: the file; its folder is made when it is missing.
        mode: ``"wb"`` or ``"w"``.
        how: further arguments of ``open``, such as ``encoding``.

    Returns:
        A context that yields the open file.

    Raises:
        OSError: the file or its folder cannot be written; it names the file.

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
    chosen = path.is_dir() or not path.is_symlink() or path.parent == Path("/dev")  # no stranger's way to a device
    if chosen and path.exists() and not path.is_file():
        with open(path, mode, opener=_to_a_reader if path.is_fifo() else None, **how) as file:  # a folder says so
            yield file
        return
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
        with suppress(OSError):  # not every file system has modes
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
    file.close()  # so late, because the lock that says that somebody is at work ends here
    flush_folder(target.parent)


def _to_a_reader(path: str, flags: int) -> int:
    """Open a pipe; one that nobody reads, which would be waited for without end, is an error."""
    file = os.open(path, flags | os.O_NONBLOCK)
    os.set_blocking(file, True)
    return file


def hidden_name(name: str) -> str:
    """Return the beginning of a hidden file's name, which leaves room for an ending within the 255 bytes of a name."""
    raw = os.fsencode(name)
    return f".{name}" if len(raw) < 230 else f".{hashlib.sha256(raw).hexdigest()}"


def _open_part(target: Path, mode: str, **how: Any) -> tuple[Path, IO[Any]]:
    """Open a file beside the target, and lock it; remove what killed processes have left of others.

    Names are counted, so that leftovers are found without a look at the whole folder.
    """
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
            file = open(part, mode.replace("w", "x"), **how)  # noqa: SIM115 - closed when it is complete
            with suppress(OSError):
                if _lock(file) is not False and os.path.samestat(os.fstat(file.fileno()), os.stat(part)):
                    return part, file
            file.close()  # another process took it for a leftover before it was locked
        n += 1


def _lock(file: IO[Any]) -> bool | None:
    """Hold the lock of a file until it is closed; return False where somebody else does, None where there are none."""
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
    """Make the renaming last through a loss of power, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
