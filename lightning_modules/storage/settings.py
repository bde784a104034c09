"""Checks of settings stored with weights: known classes, known arguments, bounded plain values."""

from __future__ import annotations

import json
import reprlib
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from inspect import Parameter, formatannotation, signature
from pathlib import Path
from threading import get_ident
from typing import Any, Literal, Union, get_args, get_origin

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from spikekit.arguments import one_line, printable

_LONGEST = 1000  # maximum length of a string
_LARGEST = 4096  # maximum absolute value of a number
_ITEMS = 16  # maximum length of a list
_NOT_STORED = ("weights",)  # a file must not make the package read another file


def own_class(
    settings: Mapping[str, Any], source: str | Path, kinds: Mapping[str, type[nn.Module]]
) -> tuple[type[nn.Module], dict[str, Any]]:
    """Return the class, one of ``kinds``, and the constructor arguments that settings of a file describe, checked."""
    name = settings.get("class")
    kind = kinds.get(name) if isinstance(name, str) else None
    if kind is None:
        raise ValueError(f"{source}: class: expected one of {', '.join(kinds)}, got {reprlib.repr(name)}")
    arguments = {key: value for key, value in settings.items() if key != "class"}
    parameters = signature(kind, eval_str=True).parameters
    known = {key: parameter.annotation for key, parameter in parameters.items() if key not in _NOT_STORED}
    for key, value in arguments.items():
        if key not in known:
            hint = "written by another version of this package?"
            raise ValueError(f"{source}: {name} accepts no argument {reprlib.repr(key)} from a file ({hint})")
        if not _fits(value, known[key]):
            expected = f"{formatannotation(known[key])}, at most {_LARGEST}"
            raise ValueError(f"{source}: {key} of {name}: expected {expected}, got {reprlib.repr(value)}")
    return kind, arguments


def check_shapes(
    settings: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    source: str | Path,
    kinds: Mapping[str, type[nn.Module]],
) -> None:
    """Check that weights fit the network that their settings describe, without allocating memory for it."""
    kind, arguments = own_class(settings, source, kinds)
    try:
        with torch.device("meta"), _at_most(2 * len(tensors) + 1000):
            network = kind(**arguments)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{source}: invalid settings of a {kind.__name__} ({one_line(error)[:300]})") from error
    load_state(network, tensors, source, assign=True)


def load_state(network: nn.Module, tensors: Mapping[str, Tensor], source: str | Path, assign: bool = False) -> None:
    """Load weights; raise a one-line ValueError if they do not fit."""
    try:
        network.load_state_dict(tensors, assign=assign)
    except RuntimeError as error:
        _, *reasons = str(error).splitlines()
        raise ValueError(f"{source}: weights do not fit ({printable(' '.join(reasons).strip())[:200]})") from error


@contextmanager
def _at_most(parameters: int) -> Iterator[None]:
    """Limit the number of parameter tensors built in this thread, as hostile settings could take hours to build."""
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
    """Check that a value consists of finite numbers, strings, and lists and dictionaries of them."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{name}: expected plain values ({one_line(error)[:200]})") from error


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value has the type of an argument and is within the bounds."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Parameter.empty:  # user-defined classes may lack annotations; values are plain
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
