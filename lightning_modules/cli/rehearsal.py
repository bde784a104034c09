"""Rehearse a command: parse and build it without running it, and report errors in one line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import yaml

from lightning_modules.cli.arguments import flatten
from lightning_modules.cli.command import Command
from lightning_modules.cli.reasons import reason, suggestion, unknown


class Rehearsal(Command):
    """Parses and builds what a verb would, and raises any errors; runs and writes nothing."""

    verb = "test"

    def init_parser(self, **kwargs: Any) -> Any:  # noqa: D102
        return super().init_parser(**kwargs, exit_on_error=False)

    def _run_subcommand(self, subcommand: str) -> None:
        pass


def resolved(command: Rehearsal) -> dict[str, Any]:
    """Return the whole configuration of a verb, as plain values."""
    return yaml.safe_load(command.parser.dump(command.config, skip_none=False, skip_validation=True))[command.verb]


def mistake(error: Exception, args: Sequence[str], names: Sequence[str]) -> str:
    """Describe in one line what is wrong with arguments.

    Args:
        error: what was raised on them.
        args: they.
        names: of all arguments that there are, of which the one that was meant is looked for.
    """
    return reason(str(error)) + suggestion(unknown(args, names), names)


def argument_names(config: dict[str, Any]) -> list[str]:
    """Return the keys of a configuration as they are typed: those of the objects in it have no ``init_args``."""
    return sorted({key.replace(".init_args", "") for key, _ in flatten(config)})
