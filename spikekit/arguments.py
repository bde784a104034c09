"""What the verbs of the command line have in common: kinds of arguments, mistakes in them, and progress."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

_BAR = 30


class UsageError(ValueError):
    """A command line that asks for what cannot be."""


def whole(least: int) -> Callable[[str], int]:
    """Return what reads a whole number, ``least`` or more."""

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least:
            raise argparse.ArgumentTypeError(f"expected a whole number, {least} or more, got {text}")
        return number

    return read


def positive(text: str) -> float:
    """Read a finite number above 0."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return number


def one_line(error: BaseException) -> str:
    """Return what an error says, on one line."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(text.split())


def progress(parts: Iterable[T], total: int, what: str, length: Callable[[T], int] = len) -> Iterator[T]:
    """Pass on parts of a whole, and show on a terminal how much of it has come.

    Args:
        parts: what comes.
        total: length of all of them.
        what: what is counted.
        length: that of a part.

    Returns:
        An iterator over the parts.
    """
    if not sys.stderr.isatty():
        yield from parts
        return
    done = 0
    try:
        _show(done, total, what)
        for part in parts:
            yield part
            done += length(part)
            _show(done, total, what)
    finally:
        sys.stderr.write("\r\033[K")
        sys.stderr.flush()


def _show(done: int, total: int, what: str) -> None:
    filled = _BAR * done // total
    sys.stderr.write(f"\r[{'#' * filled}{'.' * (_BAR - filled)}] {done} of {total} {what}")
    sys.stderr.flush()
