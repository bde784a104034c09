"""Constructors that take the arguments of another class."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TypeVar, get_type_hints

T = TypeVar("T", bound=Callable[..., None])


def takes(config: type) -> Callable[[T], T]:
    """Decorate a constructor that passes ``*args`` and ``**settings`` on to a configuration or another class.

    Its signature and its documentation become those of both, for ``help``, editors and the command line.

    Args:
        config: the class.
    """

    def decorate(init: T) -> T:
        first, *own = inspect.signature(init).parameters.values()
        own = [parameter for parameter in own if parameter.kind is parameter.KEYWORD_ONLY]
        hints = {**get_type_hints(config.__init__), **get_type_hints(init)}
        parameters = [*inspect.signature(config).parameters.values(), *own]
        parameters = [parameter.replace(annotation=hints[parameter.name]) for parameter in parameters]
        init.__signature__ = inspect.Signature([first, *parameters])
        init.__doc__ = config.__doc__
        return init

    return decorate
