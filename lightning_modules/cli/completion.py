"""Tab completion of ``lightning``: options of Lightning's verbs, of the classes that they may name, and of ours."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Any, ClassVar, NoReturn

from pytorch_lightning.cli import LightningCLI

from lightning_modules.cli.command import CHOICES, Command, option_names, run
from lightning_modules.cli.errors import UsageError
from lightning_modules.cli.short_help import VERBS
from lightning_modules.motion import ESTIMATORS
from lightning_modules.networks import NETWORKS
from lightning_modules.registry import list_models
from spikekit.arguments import UsageError as SpikekitUsageError
from spikekit.completion import completion
from spikekit.io.cameras import CAMERAS

#: what options take that no parser says
_KNOWN = {
    "--model.weights": [model.name for model in list_models() if model.scale],
    "--model.network": [*NETWORKS],
    "--model.network.motion": [*ESTIMATORS],
    "--data": [choice.__name__ for option, choice in CHOICES if option == "data"],
    "--data.camera": [*CAMERAS],
}


class _Completion(Command):
    """Prints a script instead of running a verb."""

    shell: ClassVar[str]
    ours: ClassVar[dict[str, str]]

    def subcommands(self) -> dict[str, set[str]]:
        return LightningCLI.subcommands()

    def parse_arguments(self, parser: Any, args: Any) -> NoReturn:
        top = argparse.ArgumentParser(prog="lightning")
        verbs = top.add_subparsers()
        for name, home in self.ours.items():
            parser = import_module(f"lightning_modules.{home}").parser()
            verb = verbs.add_parser(name, help=VERBS[name], parents=[parser], add_help=False)
            if name == "trade":
                _add(verb, self._subcommand_parsers["test"])
        for name, parser in self._subcommand_parsers.items():
            _add(verbs.add_parser(name, help=VERBS[name]), parser)  # without help, shtab leaves it out
        print(completion(top, self.shell), end="")
        raise SystemExit(0)


def _add(verb: argparse.ArgumentParser, parser: argparse.ArgumentParser) -> None:
    """Add the options of one of Lightning's verbs: all take a value, mostly a file or what nobody can guess."""
    for option in option_names(parser):
        if option not in verb._option_string_actions:
            action = parser._option_string_actions.get(option)
            choices = _KNOWN.get(option) or getattr(action, "choices", None)
            verb.add_argument(option, choices=choices, metavar=None if choices else "FILE")


def print_completion(shell: str, ours: dict[str, str]) -> None:
    """Print the script that lets a shell complete.

    Args:
        shell: such as ``bash``.
        ours: the modules of the verbs that are not Lightning's, by name; each has a ``parser``.

    Raises:
        UsageError: a shell that is not known, or shtab is not installed.
    """
    _Completion.shell, _Completion.ours = shell, ours
    try:
        run(["fit"], _Completion)
    except SpikekitUsageError as error:
        raise UsageError(str(error)) from error
