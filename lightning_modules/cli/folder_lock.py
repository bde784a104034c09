"""Folder locks: one run at a time in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from lightning_modules.cli.errors import InputError, UsageError
from spikekit.io.video import PICTURE_ENDINGS, VIDEO_ENDINGS

# of what users may take the output for
_FILE_ENDINGS = (*PICTURE_ENDINGS, *VIDEO_ENDINGS, ".gif", ".html", ".npz", ".dat", ".ckpt", ".safetensors")


def check_folder(output: str | Path) -> None:
    """Refuse an output that is a file, or inside one, or would be a folder that looks like a file."""
    ending = Path(output).suffix.lower()
    if ending in _FILE_ENDINGS and not Path(output).is_dir():
        raise UsageError(f"-o: expected a folder, got {output}, which ends like a file, in {ending}")
    there = next(path for path in (Path(output).absolute(), *Path(output).absolute().parents) if path.exists())
    if not there.is_dir():
        raise UsageError(f"-o: expected a folder, got the file {there}")


@contextmanager
def locked_folder(folder: str | Path, what: str, name: str = "lock") -> Iterator[None]:
    """Keep other runs out of a folder; the lock is released when the process ends, however it ends.

    On a file system without locks there is no lock. ``what`` is the kind of run, for the message, and ``name`` that of
    the file, which stays; runs that lock different files are no trouble to each other.
    """
    path = Path(folder) / name
    if path.is_symlink() or (path.exists() and not path.is_file()):  # it would be emptied, or waited for
        raise InputError(f"-o: {path}: expected the file of a lock, got a link, a pipe or a folder")
    lock = FileLock(path, timeout=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(f"{folder}: another {what} is at work here; -o goes elsewhere") from None
    except NotImplementedError:
        pass
    try:
        yield
    finally:
        lock.release()
