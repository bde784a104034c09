"""The ``spikekit`` command: inspect, decode, simulate and calibrate spike recordings."""

from __future__ import annotations

import argparse
import gc
import inspect
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any, NoReturn

from spikekit._version import __version__
from spikekit.arguments import UsageError, one_line, printable
from spikekit.extras import remedy
from spikekit.standard_output import BROKEN_PIPE, Terminated, stop_printing, stopped_by_sigterm

#: summary and example of every verb; the module of the same name has its ``add_arguments`` and ``run``
VERBS = {
    "info": ("print statistics of a recording", "info street.dat --height 250 --width 400"),
    "decode": (
        "write the pictures of one or more frames",
        "decode water.dat --height 1000 --width 1000 --flip --pattern BGGR -o water.png",
    ),
    "simulate": ("simulate a recording of a film", "simulate walk -o walk.dat --scale 4"),
    "calibrate": (
        "measure gain, dark rate and defects of pixels",
        "calibrate street.dat --height 250 --width 400 --flat wall.dat --dark cap.dat",
    ),
    "view": ("draw an overview of a recording", "view walk.dat -o look.png"),
    "cameras": ("list the cameras that --camera knows", "cameras"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        The exit status: 0, 1 for an unusable file, 2 for a wrong command line, and, as in a shell, 130 after Ctrl-C,
        141 after a broken pipe, 143 after SIGTERM. Files that were complete by then are kept.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError):  # a notebook's streams have no encoding
            stream.reconfigure(errors="backslashreplace")
    try:
        with stopped_by_sigterm():
            with suppress(SystemExit):  # --help
                words = sys.argv[1:] if argv is None else list(argv)
                if argv is None:  # collecting all that was imported takes a quarter of the command, at its end
                    gc.freeze()
                args = _parser(*words).parse_args(words)
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
            stop_printing()  # a broken pipe or a full disk
        if isinstance(error, BrokenPipeError):
            return BROKEN_PIPE
    except ModuleNotFoundError as error:
        if (said := remedy(error)) is None:
            raise
        status = 1
    print(f"spikekit: {said}", file=sys.stderr)
    return status


class _Parser(argparse.ArgumentParser):
    def parse_known_args(self, *args: Any, **options: Any) -> tuple[argparse.Namespace, list[str]]:
        # argparse would report a verb's unknown options as those of the command
        known, unknown = super().parse_known_args(*args, **options)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def _parser(*asked: str) -> argparse.ArgumentParser:
    """Return a parser with the arguments of the verbs in ``asked``; the modules of the others are not imported."""
    parser = _Parser(prog="spikekit", description="Inspect, decode, simulate and calibrate spike recordings.")
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
