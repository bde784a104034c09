"""Arguments of ``lightning`` before they are parsed: what weights say of their network is put in."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from jsonargparse import ArgumentParser

from lightning_modules import motion
from lightning_modules.pretrained import read_weights

WEIGHTS = "--model.weights", "--model.init_args.weights"

_MOTION = re.compile(r"--model\.(init_args\.)?network\.(init_args\.)?motion(\.class_path)?")

T = TypeVar("T")


def with_network_of_weights(args: Sequence[str]) -> list[str]:
    """Put in the network that ``--model.weights`` are of, so that it need not be said again.

    An estimator of motion is exchanged freely: that of the weights is put in where nothing else is named.

    Args:
        args: verb and arguments of ``lightning``.

    Raises:
        FileNotFoundError: there are no such weights.
        ValueError: the file is damaged, or of something else.
    """
    asked, named = None, None
    for _, option, value in options(args):
        if option in ("-c", "--config"):
            model = _init_args(_model_in(value))
            asked = model.get("weights") or asked
            named = _with_class(_init_args(model.get("network")).get("motion")) or named
        elif option in WEIGHTS:
            asked = value
        elif _MOTION.fullmatch(option):
            named = _with_class(yaml.safe_load(value)) or named
    if asked in (None, "", "null"):
        return list(args)
    found = read_weights(asked)
    kind = found.settings.get("class", "")
    if hasattr(motion, kind):
        takes = "--model.network.motion.weights takes them"
        raise ValueError(f"model.weights: expected weights of a network, got {asked}, of the estimator {kind}; {takes}")
    network = _class_and_arguments(found.settings)
    chosen = named or (found.motion and _class_and_arguments(found.motion))
    if chosen:
        network["init_args"]["motion"] = chosen
    return behind_configurations(args, ["--config", json.dumps({"model": {"network": network}})])


def options(args: Sequence[str]) -> Iterator[tuple[int, str, str]]:
    """Yield where the word after an option and its value is, the option, and the value."""
    for n, word in enumerate(args):
        option, equals, value = word.partition("=")
        if re.match(r"-[a-z][^=]", word):  # -cFILE
            option, equals, value = word[:2], "=", word[2:]
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


def flatten(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted keys and what is no dictionary.

    Example:
        >>> dict(flatten({"network": {"width": 4, "motion": {}}}))
        {'network.width': 4}
    """
    if not isinstance(config, dict):
        yield prefix, config
        return
    for key, value in config.items():
        yield from flatten(value, f"{prefix}.{key}" if prefix else key)


def _model_in(config: str) -> Any:
    """Return what a file of configuration says about the model; whether it is one at all is the parser's affair."""
    try:
        return yaml.safe_load(Path(config).read_text())["model"]
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        return None


def _init_args(choice: Any) -> dict[str, Any]:
    """Return the arguments of an object in a configuration, which may stand in it without ``init_args``."""
    if not isinstance(choice, dict):
        return {}
    inner = choice.get("init_args")
    return {**choice, **inner} if isinstance(inner, dict) else choice


def _with_class(choice: Any) -> dict[str, Any] | None:
    """Return an object of a configuration as a dictionary, ``None`` where it does not say of what class it is."""
    choice = {"class_path": choice} if isinstance(choice, str) else choice
    return choice if isinstance(choice, dict) and choice.get("class_path") else None


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
