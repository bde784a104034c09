"""State of a sweep on disk: small files, written whole, and checked when they are read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from lightning_modules.cli.errors import InputError
from spikekit.arguments import one_line, printable
from spikekit.io.failures import no_pipe
from spikekit.io.whole_file import whole_file

PROGRESS, RESULT, LOG = "progress.txt", "result.json", "log.txt"


def write_json(path: Path, value: Any) -> None:
    """Write a file completely or not at all."""
    with whole_file(path, "w") as file:
        file.write(json.dumps(value, indent=1))


def read_json(path: Path) -> dict[str, Any]:
    """Return what :func:`write_json` wrote."""
    return _read(path, json.loads)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the configuration in a file."""
    return _read(path, yaml.safe_load)


def read_result(folder: Path) -> dict[str, Any] | None:
    """Return the result of a trial, None where there is none yet."""
    path = folder / RESULT
    return _read(path, lambda text: check_result(json.loads(text))) if path.is_file() else None


def check_result(result: dict[str, Any]) -> dict[str, Any]:
    """Return ``scores``, ``steps``, ``seconds_per_step`` and ``parameters``; raise where one is no number."""
    for name, value in {**result, "scores": 0, **result["scores"]}.items():
        if not isinstance(value, (int, float)) or not abs(value) < 1 << 53:
            raise ValueError(f"{name}: expected a number, got {value!s:.80}")
    return {name: result[name] for name in ("scores", "steps", "seconds_per_step", "parameters")}


def say_progress(folder: Path, text: str) -> None:
    """Leave a line about a trial that is running."""
    with whole_file(folder / PROGRESS, "w") as file:
        file.write(text)


def read_progress(folder: Path) -> str:
    """Return that line; nothing where there is none."""
    path = folder / PROGRESS
    return printable(path.read_text(encoding="utf-8", errors="replace")[:200]) if path.is_file() else ""


def _read(path: Path, parse: Any) -> dict[str, Any]:
    try:
        value = parse(no_pipe(path).read_text(encoding="utf-8"))
        if not isinstance(value, dict):
            raise ValueError(f"expected names and values, got {type(value).__name__}")
    except Exception as error:  # what the parser of YAML raises depends on the text
        raise InputError(f"{path}: damaged ({one_line(error)[:300]}); delete it, or the folder") from error
    return value
