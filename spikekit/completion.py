"""Tab completion of a command line, written by shtab for a shell."""

from __future__ import annotations

import argparse
from pathlib import Path

from spikekit.arguments import UsageError

#: what asks for it, of every command
OPTION = "--print-completion"


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the script by which a shell completes verbs, options and what they take.

    Args:
        parser: all verbs of a command; an option or argument that is a path completes to files.
        shell: such as ``bash`` or ``zsh``.

    Raises:
        UsageError: a shell that is not known, or shtab is not installed.
    """
    try:
        import shtab
    except ImportError as error:
        raise UsageError(f"{OPTION}: expected shtab, pip install shtab brings it") from error
    if shell not in shtab.SUPPORTED_SHELLS:
        raise UsageError(f"{OPTION}: expected one of {', '.join(shtab.SUPPORTED_SHELLS)}, got {shell or 'none'}")
    verbs = next(action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for verb in verbs.values():
        for action in verb._actions:
            if action.type is Path or action.metavar in ("FILE", "OUT", "OUT.png", "OUT.dat"):
                action.complete = shtab.FILE
    return shtab.complete(parser, shell)
