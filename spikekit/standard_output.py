"""How commands end early: standard output that is closed or on a full disk, and SIGTERM."""

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

#: exit status of a command that was still printing when its reader went, as a shell has it: 128 + SIGPIPE
BROKEN_PIPE = 141

#: errors of a full disk, which the system reports without a name
FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO)


def say(text: str, file: IO[str] | None = None) -> None:
    """Print lines in which names of files, which can hold any character, may stand."""
    print(*map(printable, text.splitlines()), sep="\n", file=file)


def stop_printing() -> None:
    """Drop what is still to be printed: Python would complain about it when it flushes at exit."""
    with suppress(io.UnsupportedOperation):  # what is printed goes to no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Terminated(BaseException):
    """The command was asked to end, by SIGTERM."""


def _terminate(*_: object) -> NoReturn:
    raise Terminated


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """Unwind on SIGTERM, so that half files go; leave alone what somebody else has set, and other threads."""
    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if ours:
        signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
