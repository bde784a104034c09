"""The ``spikekit`` command."""

from __future__ import annotations

from collections.abc import Sequence

from spikekit._renamed import moved

_HOMES = {"CLOCK_HZ": "info", "TFI_REACH": "decode", "TFP_WINDOW": "decode"}
__getattr__ = moved(__name__, {name: f"spikekit.cli.{home}" for name, home in _HOMES.items()})


def main(args: Sequence[str] | None = None) -> int:
    """Run the command, see :func:`spikekit.cli.command.main`."""
    from spikekit.cli import command

    return command.main(args)
