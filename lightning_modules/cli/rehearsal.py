"""Rehearse a command: parse and build it without running it."""

from __future__ import annotations

from typing import Any

import yaml

from lightning_modules.cli.command import Command


class Rehearsal(Command):
    """A command that parses and builds everything and raises any errors, but runs and writes nothing."""

    verb = "test"

    def init_parser(self, **kwargs: Any) -> Any:  # noqa: D102
        return super().init_parser(**kwargs, exit_on_error=False)

    def _run_subcommand(self, subcommand: str) -> None:
        pass


def resolved(command: Rehearsal) -> dict[str, Any]:
    """Return the complete configuration of a command, as plain values."""
    return yaml.safe_load(command.parser.dump(command.config, skip_none=False, skip_validation=True))[command.verb]
