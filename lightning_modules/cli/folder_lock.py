"""Folder locks: one run at a time in a folder."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


class FolderError(ValueError):
    """A folder that a run cannot write to."""


class FolderInUseError(FolderError):
    """A folder that another run is using."""


def make_folder(folder: str | Path) -> None:
    """Make a folder and try to write to it, so that a run does not fail at its end.

    Args:
        folder: where.

    Raises:
        FolderError: it cannot be made, or not be written to.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise FolderError(f"-o: {folder} cannot be written to ({error.strerror or error})") from error


@contextmanager
def locked_folder(folder: str | Path, what: str, name: str = "lock") -> Iterator[None]:
    """Keep other runs out of a folder; the lock is released when the process ends, however it ends.

    On a file system without locks there is no lock.

    Args:
        folder: where; made when it is missing.
        what: the kind of run, for the message.
        name: of the file that is locked, and stays; runs that lock different files are no trouble to each other.

    Raises:
        FolderInUseError: another process, or another run of this one, is at work there.
        FolderError: the folder or the file in it cannot be made.
    """
    make_folder(folder)
    lock = FileLock(Path(folder) / name, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise FolderInUseError(f"{folder}: another {what} is at work here; -o goes elsewhere") from None
    except OSError as error:
        raise FolderError(f"-o: {Path(folder) / name} cannot be written ({error.strerror or error})") from error
    except NotImplementedError:
        pass
    try:
        yield
    finally:
        lock.release()
