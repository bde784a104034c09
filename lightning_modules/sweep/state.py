"""State of a sweep on disk: small JSON and YAML files, written whole, and checked when they are read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from lightning_modules.cli.errors import InputError
from spikekit.arguments import one_line
from spikekit.io.failures import no_pipe
from spikekit.io.whole_file import whole_file

PROGRESS, RESULT, LOG, COSTS = "progress.json", "result.json", "log.txt", "costs.json"

_NUMBER, _PERHAPS = (int, float), (int, float, type(None))
_BY_NAME = "by name"  # a dictionary with any keys, whose values are all of one kind

# Kinds of values by the name of the file; a key that is missing counts as None.
_KINDS: dict[str, Any] = {
    PROGRESS: {
        "phase": str, "step": _PERHAPS, "steps": _PERHAPS, "share": _PERHAPS, "rate": _PERHAPS,
        "val": ({_BY_NAME: _NUMBER}, None),
    },
    RESULT: {
        "metrics": {_BY_NAME: {_BY_NAME: _NUMBER}}, "method": (str, type(None)), "steps": int,
        "seconds_per_step": _PERHAPS, "parameters": int,
        "network": {"class": (str, type(None)), "scale": (int, type(None))},
        "optimizer": {_BY_NAME: (*_PERHAPS, str, list, bool)},
    },
    COSTS: {"trials": {_BY_NAME: str}, "variants": {_BY_NAME: {_BY_NAME: _PERHAPS}}, "where": str},
}  # fmt: skip


def write_json(path: Path, value: Any) -> None:
    """Write a file completely or not at all."""
    with whole_file(path, "w") as file:
        file.write(json.dumps(value, indent=1))


def read_json(path: Path) -> dict[str, Any] | None:
    """Return what :func:`write_json` wrote, ``None`` where it did not.

    Raises:
        InputError: the file cannot be read, or is damaged; the message is one line and names it.
    """
    return _read(path, json.loads) if path.is_file() else None


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the configuration in a file.

    Raises:
        InputError: the file cannot be read, or is damaged; the message is one line and names it.
    """
    return _read(path, yaml.safe_load)


def _read(path: Path, parse: Any) -> dict[str, Any]:
    try:
        value = parse(no_pipe(path).read_text(encoding="utf-8"))
        _check_text(value)
        _check(value, _KINDS.get(path.name, dict), "")
    except Exception as error:  # what the parser of YAML raises depends on the text
        raise InputError(f"{path}: damaged ({one_line(error)[:300]}); delete it, or the folder") from error
    return value


def _check_text(value: Any) -> None:
    """Refuse text that a terminal would obey or could not show, such as an escape sequence."""
    if isinstance(value, dict):
        _check_text([*value, *value.values()])
    elif isinstance(value, list):
        for inner in value:
            _check_text(inner)
    elif isinstance(value, str) and not value.replace("\n", "").replace("\t", "").isprintable():
        raise ValueError("expected text that can be printed, got control characters")


def _check(value: Any, kind: Any, name: str) -> None:
    """Raise unless a value is of a kind: types, or a dictionary of kinds."""
    if isinstance(kind, tuple) and isinstance(kind[0], dict):
        kind = kind[0] if value is not None else type(None)
    if isinstance(kind, dict):
        _check(value, dict, name)
        kinds = dict.fromkeys(value, kind[_BY_NAME]) if _BY_NAME in kind else kind
        for key, inner in kinds.items():
            _check(value.get(key), inner, f"{name}.{key}".strip("."))
    elif not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        expected = " or ".join(one.__name__ for one in kinds)
        raise ValueError(f"{name or 'the file'}: expected {expected}, got {type(value).__name__}")
    elif isinstance(value, int) and abs(value) > 1 << 63:
        raise ValueError(f"{name}: expected a number of 64 bits, got more")
