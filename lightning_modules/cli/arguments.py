"""Preparation of the arguments of ``lightning`` before parsing: settings stored with weights are filled in."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from lightning_modules.motion import ESTIMATORS, MotionEstimator
from lightning_modules.networks import NETWORKS
from lightning_modules.storage.pretrained import check_weights, read_weights
from lightning_modules.storage.settings import own_class
from spikekit.arguments import one_line
from spikekit.io.failures import no_pipe

WEIGHTS = "--model.weights", "--model.init_args.weights"


def with_network_of_weights(args: Sequence[str]) -> list[str]:
    """Insert the network of ``--model.weights``, so that it need not be specified again.

    It comes after all configurations and overrides their network, except its ``motion`` and ``alpha``, and a ``noise``
    that it is to learn. Other arguments override it.
    """
    asked, kept, place = None, {}, 1
    for end, option, value in options(args):
        if option in ("-c", "--config"):
            place = end
            model = inner_arguments(read_config(value).get("model")) if os.path.exists(value) else {}
            asked = model.get("weights") or asked
            network = inner_arguments(model.get("network"))
            kept |= {name: network[name] for name in ("motion", "alpha", "noise") if network.get(name)}
        elif option in WEIGHTS:
            asked = value
    if asked in (None, "", "null"):
        return list(args)
    if not isinstance(asked, str):
        raise ValueError(f"model.weights: expected a file or a name, got {repr(asked)[:80]}")
    found = read_weights(asked)
    check_weights(found, {**NETWORKS, **ESTIMATORS})
    kind, arguments = own_class(found.settings, found.source, {**NETWORKS, **ESTIMATORS})
    if issubclass(kind, MotionEstimator):
        takes = f"--model.network.motion {kind.__name__} --model.network.motion.weights {asked}"
        raise ValueError(f"model.weights: expected weights of a network, got those of an estimator; use {takes}")
    if found.motion:
        estimator, its = own_class(found.motion, found.source, ESTIMATORS)
        arguments["motion"] = {"class_path": estimator.__name__, "init_args": its}
    network = {"class_path": kind.__name__, "init_args": arguments | kept}
    inserted = "--config", json.dumps({"model": {"network": network}}, default=str)
    return [*args[:place], *inserted, *args[place:]]


def options(args: Sequence[str]) -> Iterator[tuple[int, str, str]]:
    """Yield the position after an option and its value, the option, and the value.

    Example:
        >>> list(options(["-cA.yaml", "--config=B.yaml", "-c", "C.yaml"]))
        [(1, '-c', 'A.yaml'), (2, '--config', 'B.yaml'), (4, '-c', 'C.yaml'), (5, 'C.yaml', '')]
    """
    for n, word in enumerate(args):
        option, equals, value = word.partition("=")
        if re.match(r"-[a-z][^=]", word):  # -cFILE
            option, equals, value = word[:2], "=", word[2:]
        yield (n + 1, option, value) if equals else (n + 2, option, args[n + 1] if n + 1 < len(args) else "")


def given_data(args: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of the data in configurations and options; of several values, the last.

    Example:
        >>> given_data(["--data.alpha", "0.5", "--data.init_args.scale=2", "--data.scale=3"])
        {'alpha': 0.5, 'scale': 3}
    """
    import yaml

    given: dict[str, Any] = {}
    for _, option, value in options(args):
        if option in ("-c", "--config") and os.path.exists(value):
            given |= inner_arguments(read_config(value).get("data"))
        elif named := re.fullmatch(r"--data\.(?:init_args\.)?(\w+)", option):
            given[named[1]] = yaml.safe_load(value)
    return given


def flatten(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted keys and the values that are not dictionaries.

    Example:
        >>> dict(flatten({"network": {"width": 4, "motion": {}}}))
        {'network.width': 4}
    """
    if not isinstance(config, dict):
        yield prefix, config
        return
    for key, value in config.items():
        yield from flatten(value, f"{prefix}.{key}" if prefix else str(key))


def read_config(path: str | Path) -> dict[str, Any]:
    """Return the content of a configuration file; nothing is built."""
    import yaml

    path = Path(path).expanduser()
    try:
        content = yaml.safe_load(no_pipe(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {one_line(error)}") from error
    except Exception as error:  # the type depends on the text
        said = "expected UTF-8" if isinstance(error, UnicodeError) else one_line(error)[:300]
        raise ValueError(f"{path}: not a configuration ({said})") from error
    if content is not None and not isinstance(content, dict):
        raise ValueError(f"{path}: not a configuration (expected names and values, got {type(content).__name__})")
    return content or {}


def inner_arguments(choice: Any) -> dict[str, Any]:
    """Return the arguments of an object in a configuration, with or without ``init_args``."""
    if not isinstance(choice, dict):
        return {}
    inner = choice.get("init_args")
    return {**choice, **inner} if isinstance(inner, dict) else choice
