"""A setting: a name for arguments of ``lightning test``."""

from __future__ import annotations

import shlex
from typing import NamedTuple

from lightning_modules.inference.presets import Preset


class Setting(NamedTuple):
    """Arguments to be measured, and what they are called.

    Args:
        name: what it is called.
        args: arguments of ``lightning test`` that make it, behind those that all settings share.
        preset: the same as columns of a table; ``None`` where the arguments say what a preset cannot.
    """

    name: str
    args: list[str]
    preset: Preset | None = None

    @property
    def text(self) -> str:
        """As :func:`lightning_modules.trade.settings.read_setting` takes it.

        Example:
            >>> Setting("small tiles", ["--tile", "32"]).text
            'small tiles: --tile 32'
        """
        typed = shlex.join(self.args)
        return typed if typed == self.name else f"{self.name}: {typed}".rstrip()
