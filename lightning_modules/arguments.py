"""Arguments of ``lightning`` before they are parsed: what weights say of their network is put in."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from jsonargparse import ArgumentParser

from lightning_modules.pretrained import read_weights

WEIGHTS = "--model.weights", "--model.init_args.weights"

T = TypeVar("T")


def with_network_of_weights(args: Sequence[str]) -> list[str]:
    """Put in the network that ``--model.weights`` are of, so that it need not be said again.

    Args:
        args: verb and arguments of ``lightning``.

    Raises:
        FileNotFoundError: there are no such weights.
        ValueError: the file is damaged, or of something else.
    """
    asked = None
    for _, option, value in options(args):
        if option in ("-c", "--config"):
            asked = _weights_in(value) or asked
        elif option in WEIGHTS:
            asked = value
    if asked in (None, "", "null"):
        return list(args)
    found = read_weights(asked)
    network = _class_and_arguments(found.settings)
    if found.motion:
        network["init_args"]["motion"] = _class_and_arguments(found.motion)
    return behind_configurations(args, ["--config", json.dumps({"model": {"network": network}})])


def options(args: Sequence[str]) -> Iterator[tuple[int, str, str]]:
    """Yield where the word after an option and its value is, the option, and the value."""
    for n, word in enumerate(args):
        option, equals, value = word.partition("=")
        yield (n + 1, option, value) if equals else (n + 2, option, args[n + 1] if n + 1 < len(args) else "")


def behind_configurations(args: Sequence[str], more: Sequence[str]) -> list[str]:
    """Put more behind the verb and all configurations, where other arguments still have the last word."""
    place = max((end for end, option, _ in options(args) if option in ("-c", "--config")), default=1)
    return [*args[:place], *more, *args[place:]]


def _class_and_arguments(settings: dict[str, Any]) -> dict[str, Any]:
    return {
        "class_path": settings["class"],
        "init_args": {name: value for name, value in settings.items() if name != "class"},
    }


def _weights_in(config: str) -> str | None:
    """Return what a file of configuration says about weights; whether it is one at all is the parser's affair."""
    try:
        model = yaml.safe_load(Path(config).read_text())["model"]
        return model.get("weights") or model["init_args"].get("weights")
    except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError):
        return None


def make_module(kind: type[T], args: Sequence[str]) -> T:
    """Build a module as ``lightning`` would.

    Args:
        kind: its class.
        args: those arguments of a verb that are of the model.
    """
    parser = ArgumentParser(exit_on_error=False)
    parser.add_subclass_arguments(kind, "model")
    parser.add_argument("-c", "--config", action="config")
    _, *args = with_network_of_weights(["", *args])
    return parser.instantiate(parser.parse_args(["--model", f"{kind.__module__}.{kind.__name__}", *args])).model
