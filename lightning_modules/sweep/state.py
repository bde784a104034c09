"""What a trial says about itself while it runs, and what is left when it is done: two small files in its folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

PROGRESS, RESULT, LOG = "progress.json", "result.json", "log.txt"


def write_json(path: Path, value: Any) -> None:
    """Write a file that is there whole or not at all."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(value, indent=1))
    partial.replace(path)


def read_json(path: Path) -> dict[str, Any] | None:
    """Return what :func:`write_json` wrote, ``None`` where it did not."""
    return json.loads(path.read_text()) if path.is_file() else None
