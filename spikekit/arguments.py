"""Argument types of the command line, and their errors."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable
from pathlib import Path


class UsageError(ValueError):
    """An invalid command line."""


def whole(least: int) -> Callable[[str], int]:
    """Return an argument type for whole numbers >= ``least``."""

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least:
            raise argparse.ArgumentTypeError(f"expected a whole number, {least} or more, got {text}")
        return number

    return read


def frames_of(name: str, text: str, first: int, last: int, step: int = 1) -> range:
    """Parse an option ``N`` or ``A:B[:STEP]``, the frames A to B - 1; all must lie within ``first`` .. ``last``.

    Example:
        >>> list(frames_of("--frame", "20:80:20", 20, 99)), list(frames_of("--frame", ":23", 20, 99))
        ([20, 40, 60], [20, 21, 22])
    """
    if not re.fullmatch(r"\d+|\d*:\d*(:0*[1-9]\d*)?", text, re.ASCII):
        raise UsageError(f"{name}: expected a whole number, 0 or more, or A:B or A:B:STEP, got {text}")
    if ":" in text:
        begin, end, every = (text + ":").split(":")[:3]
        if begin and end and int(begin) >= int(end):
            raise UsageError(f"{name}: expected A below B in A:B, got {text}")
        chosen = range(int(begin or first), int(end or last + 1), int(every or step))
    else:
        chosen = range(int(text), int(text) + 1)
    if not chosen or chosen.start < first or chosen.stop > last + 1:
        raise UsageError(f"{name}: expected frames within {first} .. {last}, got {text}")
    return chosen


def positive(text: str) -> float:
    """Parse a finite number above 0."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return number


def ending_in(*endings: str, said: str) -> Callable[[str], Path]:
    """Return an argument type for files with one of ``endings``; ``said`` describes them in the error message."""

    def read(text: str) -> Path:
        path = home_path(text)
        if path.suffix.lower() not in endings:
            raise argparse.ArgumentTypeError(f"expected {said}, got {text}")
        return path

    return read


def one_line(error: BaseException) -> str:
    """Return an error's message on one line, without control characters."""
    text = getattr(error, "strerror", None) or str(error).strip() or type(error).__name__
    return printable(" ".join(text.split()))


def printable(text: str) -> str:
    """Replace control characters, which names of files may hold, by question marks."""
    return "".join(c if c.isprintable() else "?" for c in text)


def home_path(path: str | os.PathLike[str]) -> Path:
    """Expand ``~``, which a shell does not expand in quotes or after ``=``."""
    return Path(os.path.expanduser(path))
