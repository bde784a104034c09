"""The ``lightning`` command, and ``python -m lightning_modules``: one of Lightning's verbs, or one of ours."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

VERBS = ("fit", "validate", "test", "predict", "sweep", "trade", "export", "models")


def main(args: Sequence[str] | None = None) -> None:
    """Run the command.

    Args:
        args: what was typed after ``lightning``; ``sys.argv`` when not given.
    """
    # Threads of torch that spin while they wait hold up the workers that make clips: before torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from lightning_modules.cli import errors

    verb, *rest = (sys.argv[1:] if args is None else args) or [""]
    with errors.as_one_line():
        if verb == "--version":
            from spikekit import __version__

            print(f"lightning of spikekit {__version__}")  # noqa: T201
        elif verb not in VERBS and not verb.startswith("-"):
            got = f"got {verb}" if verb else "got none"
            raise errors.UsageError(f"expected a verb, one of {', '.join(VERBS)}, {got} (see lightning --help)")
        elif verb == "models":
            from lightning_modules.cli.models import models

            models(rest)
        elif verb == "sweep":
            from lightning_modules.sweep.cli import sweep

            sweep(rest)
        elif verb == "trade":
            from lightning_modules.trade.cli import trade

            trade(rest)
        elif verb == "export":
            from lightning_modules.cli.export import export

            export(rest)
        else:
            from lightning_modules.cli.command import Command, run

            run(args, Command)


if __name__ == "__main__":
    main()
