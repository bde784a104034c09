"""Tab completion of ``lightning``: the verbs, and the options that their short help lists."""

from __future__ import annotations

import argparse
from importlib import import_module

from lightning_modules.cli.errors import UsageError
from lightning_modules.cli.short_help import VERBS, options_of
from lightning_modules.registry import list_models
from spikekit.arguments import UsageError as SpikekitUsageError
from spikekit.completion import completion


def print_completion(shell: str, ours: dict[str, str]) -> None:
    """Print the script that lets a shell complete.

    Args:
        shell: such as ``bash``.
        ours: the modules of the verbs that are not Lightning's, by name; each has a ``parser``.

    Raises:
        UsageError: a shell that is not known, or shtab is not installed.
    """
    top = argparse.ArgumentParser(prog="lightning")
    verbs = top.add_subparsers()
    known = {"--model.weights": [model.name for model in list_models() if model.scale]}
    for name, said in VERBS.items():
        if name in ours:
            parser = import_module(f"lightning_modules.{ours[name]}").parser()
            verbs.add_parser(name, help=said, parents=[parser], add_help=False)
            continue
        verb = verbs.add_parser(name, help=said)  # without help, shtab leaves it out
        for option in options_of(name):
            verb.add_argument(option, choices=known.get(option), metavar=None if option in known else "FILE")
    try:
        print(completion(top, shell), end="")
    except SpikekitUsageError as error:
        raise UsageError(str(error)) from error
