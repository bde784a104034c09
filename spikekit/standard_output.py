"""Early ends of commands: a closed standard output, a full disk, SIGTERM."""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, NoReturn

from spikekit.arguments import printable

#: exit status after a broken pipe, as in a shell: 128 + SIGPIPE
BROKEN_PIPE = 141

#: errors of a full disk, for which the system names no file
FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO)


def say(text: str, file: IO[str] | None = None) -> None:
    """Print text that may contain names of files, without their control characters."""
    print(*map(printable, text.splitlines()), sep="\n", file=file)


def stop_printing() -> None:
    """Discard pending output, which Python would otherwise fail to flush at exit."""
    with suppress(io.UnsupportedOperation):  # standard output is not a file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Terminated(BaseException):
    """The process received SIGTERM."""


def _terminate(*_: object) -> NoReturn:
    raise Terminated


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """Unwind on SIGTERM, to remove partial files, unless a handler is set or this is not the main thread."""
    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if ours:
        signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
