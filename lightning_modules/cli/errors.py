"""Errors of users, which the ``lightning`` command shows as one line."""

from __future__ import annotations

import argparse
import errno
import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from spikekit.arguments import UsageError as SpikekitUsageError
from spikekit.arguments import one_line, printable
from spikekit.extras import remedy
from spikekit.standard_output import BROKEN_PIPE, FULL, Terminated, stop_printing


class InputError(ValueError):
    """Unusable input; the command shows one line and ends with status 1."""


class UsageError(InputError, SpikekitUsageError):
    """An invalid command line; the command shows one line and ends with status 2."""


class Ended(SystemExit):
    """End of the command with a line on stderr: status 2 for a wrong command line, 130 or 143 after a signal, or 1."""

    def __init__(self, line: str, status: int) -> None:
        line = "\n".join(map(printable, line.splitlines()))  # names of files can hold escape sequences
        super().__init__(line)
        self.code = line if status == 1 else status  # Python prints a text and exits with 1
        if status != 1:
            print(line, file=sys.stderr)


class VerbParser(argparse.ArgumentParser):
    """Parser of a verb that is not Lightning's; its errors are one line."""

    def error(self, message: str) -> NoReturn:  # noqa: D102
        raise UsageError(f"{self.prog.removeprefix('lightning ')}: {message}")


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error, what caused it, what caused that, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


@contextmanager
def input_errors() -> Iterator[None]:
    """Turn errors about files and values into errors of the user."""
    try:
        yield
    except (InputError, ModuleNotFoundError):
        raise
    except (OSError, ValueError, ImportError) as error:
        name = getattr(error, "filename", None)
        said = str(error) if name is None else f"{name}: {one_line(error)}"
        raise (UsageError if isinstance(error, SpikekitUsageError) else InputError)(said) from error


@contextmanager
def as_one_line() -> Iterator[None]:
    """End the program with one line and no traceback after an error of the user, a signal, or on a full disk.

    If the reader of standard output is gone, as in ``lightning models | head -1``, the program ends silently.
    Characters that the terminal cannot show are escaped.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            yield
        finally:
            print(end="", flush=True)
    except OSError as error:
        if error.filename is not None:
            raise Ended(f"lightning: {error.filename}: {one_line(error)}", 1) from error
        if error.errno not in (errno.EPIPE, *FULL):
            raise
        stop_printing()
        if isinstance(error, BrokenPipeError):
            raise SystemExit(BROKEN_PIPE) from error
        raise Ended(f"lightning: {one_line(error)}", 1) from error
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and (line := remedy(error)):
            raise Ended(f"lightning: {line}", 1) from error
        # our own error classes mean errors of the user, such as a damaged file; Lightning's mean wrong Trainer options
        if not type(error).__module__.startswith(("lightning_modules.", "spikekit.", "lightning_fabric.")):
            raise
        # the error of a worker of a loader is the last line of a traceback
        text = str(error).strip()
        said = text.splitlines()[-1].split("Error: ", 1)[-1] if "Traceback (" in text else text
        raise Ended(f"lightning: {said}", 2 if isinstance(error, SpikekitUsageError) else 1) from error
    except (Terminated, KeyboardInterrupt) as error:
        name, status = ("Ctrl-C", 130) if isinstance(error, KeyboardInterrupt) else ("SIGTERM", 143)
        raise Ended(f"lightning: stopped by {name}; complete results are saved", status) from None
