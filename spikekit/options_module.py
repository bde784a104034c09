"""The base of modules that show their options."""

from __future__ import annotations

from inspect import signature

from torch import nn


class OptionsModule(nn.Module):
    """A module whose options are attributes of the names that its constructor has."""

    def extra_repr(self) -> str:  # noqa: D102
        options = {name: getattr(self, name) for name in signature(type(self)).parameters}
        return ", ".join(f"{name}={value!r}" for name, value in options.items() if value is not None)
