"""The ``spikekit`` command: look into recordings and turn them into pictures."""

from __future__ import annotations

import argparse
import inspect
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from spikekit._version import __version__
from spikekit.arguments import UsageError, one_line, printable
from spikekit.extras import remedy
from spikekit.standard_output import BROKEN_PIPE, Terminated, stop_printing, stopped_by_sigterm

#: what every verb does, and an example; ``add_arguments`` and ``run`` are those of the module of its name
VERBS = {
    "info": ("what a recording holds", "info street.dat --height 250 --width 400"),
    "decode": (
        "the picture of one frame, or of many",
        "decode water.dat --height 1000 --width 1000 --flip --pattern BGGR -o water.png",
    ),
    "simulate": ("a stream of a film", "simulate walk -o walk.dat --scale 4"),
    "calibrate": (
        "gain and defects of pixels",
        "calibrate street.dat --height 250 --width 400 --flat wall.dat --dark cap.dat",
    ),
    "view": ("a sheet of pictures about a recording", "view walk.dat -o look.png"),
    "cameras": ("the cameras that --camera knows", "cameras"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0; 1 for a file that cannot be used, 2 for a command line that cannot, and as a shell has it 130 for Ctrl-C, 141
        for output that nobody reads any more, 143 for SIGTERM. What was whole by then has been written.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError):  # in a notebook, which shows any name
            stream.reconfigure(errors="backslashreplace")
    try:
        with stopped_by_sigterm():
            with suppress(SystemExit):  # --help
                words = sys.argv[1:] if argv is None else list(argv)
                args = _parser(*words[:1]).parse_args(words)
                args.run(args)
            print(end="", flush=True)
        return 0
    except KeyboardInterrupt:
        said, status = "interrupted", 128 + signal.SIGINT
    except Terminated:
        said, status = "terminated", 128 + signal.SIGTERM
    except (ValueError, MemoryError) as error:
        said, status = one_line(error), 2 if isinstance(error, UsageError) else 1
    except OSError as error:
        said, status = f"{printable(str(error.filename or 'standard output'))}: {one_line(error)}", 1
        if error.filename is None:
            stop_printing()  # nobody reads it, or it finds no room
        if isinstance(error, BrokenPipeError):
            return BROKEN_PIPE
    except ModuleNotFoundError as error:
        if (said := remedy(error)) is None:
            raise
        status = 1
    print(f"spikekit: {said}", file=sys.stderr)
    return status


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def _parser(*asked: str) -> argparse.ArgumentParser:
    """Return a parser that knows the arguments of some verbs: those of the others would take importing them."""
    parser = _Parser(prog="spikekit", description="Look into spike recordings and turn them into pictures.")
    parser.add_argument("--version", action="version", version=f"spikekit {__version__}")
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    for name, (summary, example) in VERBS.items():
        verb = verbs.add_parser(
            name,
            help=summary,
            epilog=f"example:\n  spikekit {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name in asked:
            module = import_module(f"spikekit.cli.{name}")
            verb.description = inspect.getdoc(module.run)
            verb.set_defaults(run=module.run)
            module.add_arguments(verb)
    return parser
