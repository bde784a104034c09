"""User errors, which the ``lightning`` command shows as one line."""

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
    """Unusable input from the user; shown as one line, and the command ends with status 1."""


class UsageError(InputError, SpikekitUsageError):
    """A command line that asks for something impossible; shown as one line, and the command ends with status 2."""


class Ended(SystemExit):
    """The end of the command with a line on stderr.

    Args:
        line: what is wrong.
        status: 2 for a command line that cannot be, 130 and 143 for one that was stopped, 1 for all else.
    """

    def __init__(self, line: str, status: int) -> None:
        line = "\n".join(map(printable, line.splitlines()))  # names of files can hold escape sequences
        super().__init__(line)
        self.code = line if status == 1 else status  # a text is printed by Python, which then ends with 1
        if status != 1:
            print(line, file=sys.stderr)


class VerbParser(argparse.ArgumentParser):
    """The arguments of one of our own verbs; errors in them are one line."""

    def error(self, message: str) -> NoReturn:  # noqa: D102
        raise UsageError(f"{self.prog.removeprefix('lightning ')}: {message}")


@contextmanager
def input_errors() -> Iterator[None]:
    """Take a file that cannot be used, or a value that cannot be, for a mistake of the user and not of the program."""
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
    """End the program with one line, and no traceback, if the user made a mistake, stopped it, or a disk is full.

    Where the reader of standard output is gone, as in ``lightning models | head -1``, it ends without a word. What the
    terminal cannot show, such as a file's name, is printed with escapes.
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
        # errors of kinds that are defined here are users', such as a damaged file; Lightning's are of a bad Trainer
        if not type(error).__module__.startswith(("lightning_modules.", "spikekit.", "lightning_fabric.")):
            raise
        # what a worker of a loader raises comes with its traceback, whose last line it is
        text = str(error).strip()
        said = text.splitlines()[-1].split("Error: ", 1)[-1] if "Traceback (" in text else text
        raise Ended(f"lightning: {said}", 2 if isinstance(error, SpikekitUsageError) else 1) from error
    except (Terminated, KeyboardInterrupt) as error:
        name, status = ("Ctrl-C", 130) if isinstance(error, KeyboardInterrupt) else ("SIGTERM", 143)
        raise Ended(f"lightning: stopped by {name}; what is whole has been written", status) from None
