"""Configurations of networks: frozen dataclasses whose fields are checked by their types."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Literal, get_args, get_origin, get_type_hints

from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import cfa_pattern


def check_fields(config: Any) -> None:
    """Check every field of a dataclass by its type, and write whole numbers as Python's own.

    ``int`` is a whole number, 1 or more; ``float`` a finite number above 0; a ``Literal`` one of its choices; a field
    called ``pattern`` a Bayer phase, or ``"grey"``. A field that may be None is checked where it is not.

    Args:
        config: a dataclass, in its ``__post_init__``.

    Raises:
        TypeError: no number where one was expected.
        ValueError: anything else that is not of the type; the message names the field.
    """
    hints = get_type_hints(type(config))
    for field in fields(config):
        name, value, hint = field.name, getattr(config, field.name), hints[field.name]
        if type(None) in get_args(hint):
            if value is None:
                continue
            hint = next(kind for kind in get_args(hint) if kind is not type(None))
        if hint is int:
            value = check_whole(name, value)
        elif hint is float:
            check_positive(name, value)
        elif hint is bool and not isinstance(value, bool):
            raise ValueError(f"{name}: expected true or false, got {value!r}")
        elif get_origin(hint) is Literal and value not in get_args(hint):
            raise ValueError(f"{name}: expected one of {', '.join(get_args(hint))}, got {value!r}")
        elif name == "pattern":
            value = cfa_pattern(value)
        object.__setattr__(config, name, value)  # frozen
