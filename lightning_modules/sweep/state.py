"""State of a sweep on disk: small files, written atomically and checked on reading."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from lightning_modules.cli.errors import InputError
from spikekit.arguments import one_line, printable
from spikekit.io.failures import no_pipe
from spikekit.io.whole_file import write_whole

PROGRESS, RESULT, LOG = "progress.txt", "result.json", "log.txt"


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically."""
    write_whole(path, json.dumps(value, indent=1))


def read_settings(path: Path) -> dict[str, Any]:
    """Return the content of a JSON or YAML file."""
    return _read(path, json.loads if path.suffix == ".json" else yaml.safe_load)


def read_result(folder: Path) -> dict[str, Any] | None:
    """Return the result of a trial, ``None`` if it has none yet."""
    path = folder / RESULT
    return _read(path, lambda text: check_result(json.loads(text))) if path.is_file() else None


def check_result(result: dict[str, Any]) -> dict[str, Any]:
    """Return ``scores``, ``steps``, ``seconds_per_step`` and ``parameters``; raise if one is not a finite number."""
    for name, value in {**result, "scores": 0, **result["scores"]}.items():
        if not isinstance(value, (int, float)) or not abs(value) < 1 << 53:
            raise ValueError(f"{name}: expected a number, got {value!s:.80}")
    return {name: result[name] for name in ("scores", "steps", "seconds_per_step", "parameters")}


def say_progress(folder: Path, text: str) -> None:
    """Write the progress line of a trial."""
    write_whole(folder / PROGRESS, text)


def read_progress(folder: Path) -> str:
    """Return the progress line of a trial, empty if there is none."""
    path = folder / PROGRESS
    return printable(path.read_text(encoding="utf-8", errors="replace")[:200]) if path.is_file() else ""


def _read(path: Path, parse: Any) -> dict[str, Any]:
    try:
        value = parse(no_pipe(path).read_text(encoding="utf-8"))
        if not isinstance(value, dict):
            raise ValueError(f"expected names and values, got {type(value).__name__}")
    except Exception as error:  # the type depends on the text
        raise InputError(f"{path}: damaged ({one_line(error)[:300]}); delete it, or the folder") from error
    return value
