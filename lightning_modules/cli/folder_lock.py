"""Folder locks: one run at a time in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from lightning_modules.cli.errors import InputError, UsageError
from spikekit.io.video import PICTURE_ENDINGS, VIDEO_ENDINGS

# names that look like files
_FILE_ENDINGS = (*PICTURE_ENDINGS, *VIDEO_ENDINGS, ".gif", ".html", ".npz", ".dat", ".ckpt", ".safetensors")


def check_folder(output: str | Path) -> None:
    """Check that an output can be a folder: it is no file, is not inside one, and has no name of a file."""
    ending = Path(output).suffix.lower()
    if ending in _FILE_ENDINGS and not Path(output).is_dir():
        raise UsageError(f"-o: expected a folder, got {output}, which has the ending of a file, {ending}")
    there = next(path for path in (Path(output).absolute(), *Path(output).absolute().parents) if path.exists())
    if not there.is_dir():
        raise UsageError(f"-o: expected a folder, got the file {there}")


@contextmanager
def locked_folder(folder: str | Path, what: str, name: str = "lock") -> Iterator[None]:
    """Lock a folder against other runs; the lock ends with the process.

    ``what`` is the kind of run, for the message, and ``name`` the name of the lock file, which is kept. Runs with
    different lock files do not exclude each other. File systems without locks are not locked.
    """
    path = Path(folder) / name
    if path.is_symlink() or (path.exists() and not path.is_file()):  # would be emptied, or block
        raise InputError(f"-o: {path}: expected a lock file, got a link, a pipe or a folder")
    lock = FileLock(path, timeout=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(f"{folder}: another {what} uses this folder; choose another -o") from None
    except NotImplementedError:
        pass
    try:
        yield
    finally:
        lock.release()
