"""Settings stored with weights: known classes, known arguments, plain values with bounds."""

from __future__ import annotations

import json
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from inspect import Parameter, signature
from pathlib import Path
from threading import get_ident
from typing import Any, Literal, Union, get_args, get_origin

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from spikekit.arguments import one_line, printable

_LONGEST = 1000  # characters of a text
_LARGEST = 4096  # of numbers
_ITEMS = 16  # of a list of whole numbers
_NOT_STORED = ("weights",)  # would make one file read another


def own_class(
    settings: Mapping[str, Any], source: str | Path, kinds: Mapping[str, type[nn.Module]]
) -> tuple[type[nn.Module], dict[str, Any]]:
    """Return the class that settings out of a file name, one of ``kinds``, and the arguments to build it with.

    Raises:
        ValueError: another class, an argument that it does not take, or a value that is not of the argument's type or
            too large; the message is one line and names the file.
    """
    name = settings.get("class")
    kind = kinds.get(name) if isinstance(name, str) else None
    if kind is None:
        raise ValueError(f"{source}: class: expected one of {', '.join(kinds)}, got {_short(name)}")
    arguments = {key: value for key, value in settings.items() if key != "class"}
    parameters = signature(kind, eval_str=True).parameters
    known = {key: parameter.annotation for key, parameter in parameters.items() if key not in _NOT_STORED}
    for key, value in arguments.items():
        if key not in known:
            hint = "written by another version of this package?"
            raise ValueError(f"{source}: {name} takes no {_short(key)} out of a file ({hint})")
        if not _fits(value, known[key]):
            expected = f"{_said(known[key])}, at most {_LARGEST}"
            raise ValueError(f"{source}: {key} of {name}: expected {expected}, got {_short(value)}")
    return kind, arguments


def check_shapes(
    settings: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    source: str | Path,
    kinds: Mapping[str, type[nn.Module]],
) -> None:
    """Compare weights with the network that their settings describe, before it takes any memory.

    Raises:
        ValueError: as :func:`own_class`, settings that contradict each other, or other names, shapes or kinds of
            numbers; the message is one line and names the file.
    """
    kind, arguments = own_class(settings, source, kinds)
    try:
        with torch.device("meta"), _at_most(2 * len(tensors) + 1000):
            network = kind(**arguments)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{source}: settings that do not make a {kind.__name__} ({one_line(error)[:300]})") from error
    load_state(network, tensors, source, assign=True)


def load_state(network: nn.Module, tensors: Mapping[str, Tensor], source: str | Path, assign: bool = False) -> None:
    """Load weights, or say in one line that those of the file do not fit."""
    try:
        network.load_state_dict(tensors, assign=assign)
    except RuntimeError as error:
        _, *reasons = str(error).splitlines()
        raise ValueError(f"{source}: weights that do not fit ({printable(' '.join(reasons).strip())[:200]})") from error


@contextmanager
def _at_most(parameters: int) -> Iterator[None]:
    """Stop the building of modules in this thread that have many more parameters than a file: it would take hours."""
    left, here = parameters, get_ident()

    def count(*_: Any) -> None:
        nonlocal left
        left -= get_ident() == here
        if left < 0:
            raise ValueError("far more weights than the file has")

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def check_plain(name: str, value: Any) -> None:
    """Refuse anything but finite numbers, texts, and lists and dictionaries of them.

    Raises:
        ValueError: something else; the message is one line.
    """
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{name}: expected plain values ({one_line(error)[:200]})") from error


def _fits(value: Any, hint: Any) -> bool:
    """Say whether a value is of the type of an argument, and no larger than it may be."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Parameter.empty:  # of a user's own class; what a file says is plain
        return True
    if origin in (Union, types.UnionType):
        return any(_fits(value, choice) for choice in inner)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in inner)
    if origin in (list, tuple, Sequence):
        return isinstance(value, (list, tuple)) and len(value) <= _ITEMS and all(_fits(n, inner[0]) for n in value)
    if hint in (float, int):
        return type(value) in (int, hint) and abs(value) <= _LARGEST
    if hint is str:
        return isinstance(value, str) and len(value) <= _LONGEST
    return hint in (bool, types.NoneType) and type(value) is hint


def _said(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint).replace("typing.", "")


def _short(value: Any) -> str:
    """Return a value for a message of one line; a tensor or a long list would fill pages."""
    if not isinstance(value, (str, int, float, bool, types.NoneType)):
        return f"a {type(value).__name__}"
    if isinstance(value, int) and value.bit_length() > 200:
        return f"a number of {value.bit_length()} bits"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
