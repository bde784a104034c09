"""The ``lightning`` command, and ``python -m lightning_modules``: one of Lightning's verbs, or one of ours."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from lightning_modules.cli import errors
from lightning_modules.cli.short_help import VERBS, overview, usage
from lightning_modules.configurations import with_found_configs
from spikekit.standard_output import stopped_by_sigterm

#: where the verbs that are not Lightning's are
_OURS = {
    "predict": "cli.predict",
    "sweep": "sweep.cli",
    "trade": "trade.cli",
    "adapt": "adaptation.cli",
    "export": "cli.export",
    "models": "cli.models",
}


def main(args: Sequence[str] | None = None) -> None:
    """Run the command.

    Args:
        args: what was typed after ``lightning``; ``sys.argv`` when not given.
    """
    typed = sys.argv[1:] if args is None else list(args)
    with errors.as_one_line():
        verb, *rest = typed or [""]
        if verb in ("-h", "--help"):
            print(overview())  # noqa: T201
        elif verb == "--version":
            from spikekit import __version__

            print(f"lightning of spikekit {__version__}")  # noqa: T201
        elif verb not in VERBS:
            expected = f"expected a verb, one of {', '.join(VERBS)}, got {verb or 'none'}"
            raise errors.Ended(f"lightning: {expected} (see lightning --help)", 2)
        elif verb not in _OURS and {"-h", "--help"} & {*rest}:
            print(usage(verb))  # noqa: T201
        else:
            # Threads of torch that spin while they wait hold up the workers that make clips: before it is imported.
            os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
            if "" not in sys.path and os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())  # where users' own networks are; behind all else, so that it hides nothing
            if verb in _OURS:
                run = getattr(import_module(f"lightning_modules.{_OURS[verb]}"), verb)
                with stopped_by_sigterm():  # Lightning's verbs have a way of their own, which leaves a checkpoint
                    run(with_found_configs(rest))
            else:
                from lightning_modules.cli.command import run

                run(typed)


if __name__ == "__main__":
    main()
