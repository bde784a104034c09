"""Constructors that accept the arguments of another class."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import TypeVar, get_type_hints

T = TypeVar("T", bound=Callable[..., None])


def inherit_signature(other: type, *without: str) -> Callable[[T], T]:
    """Decorate a constructor that passes ``**settings``, and optionally ``*args``, to another class.

    The decorator combines both signatures, for ``help``, editors and the command line. The constructor's own arguments
    take precedence, and the arguments ``without`` of the other class are left out.
    """

    def decorate(init: T) -> T:
        first, *own = inspect.signature(init).parameters.values()
        in_place = any(parameter.kind is parameter.VAR_POSITIONAL for parameter in own)
        own = {one.name: one for one in own if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)}
        passed = [one for one in inspect.signature(other).parameters.values() if one.name not in {*own, *without}]
        passed = passed if in_place else [one.replace(kind=one.KEYWORD_ONLY) for one in passed]
        passed_hints = get_type_hints(other if is_dataclass(other) else other.__init__)  # resolved in the base's module
        hints = {**passed_hints, **get_type_hints(init)}
        parameters = [one.replace(annotation=hints[one.name]) for one in (*passed, *own.values())]
        init.__signature__ = inspect.Signature([first, *sorted(parameters, key=lambda one: one.kind)])
        init.__doc__ = other.__doc__
        return init

    return decorate
