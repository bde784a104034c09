"""The ``spikekit`` command."""

from __future__ import annotations

from collections.abc import Sequence

from spikekit._renamed import moved

_COMMAND = "CLOCK_HZ", "TFI_REACH", "TFP_WINDOW", "decode", "info"
__getattr__ = moved(__name__, dict.fromkeys(_COMMAND, "spikekit.cli.command"))


def main(args: Sequence[str] | None = None) -> int:
    """Run the command, see :func:`spikekit.cli.command.main`."""
    from spikekit.cli import command

    return command.main(args)
