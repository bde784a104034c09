"""State of a trial on disk: two small JSON files, one while it runs and one when it is done."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from spikekit.io.whole_file import whole_file

PROGRESS, RESULT, LOG, COSTS = "progress.json", "result.json", "log.txt", "costs.json"


def write_json(path: Path, value: Any) -> None:
    """Write a file that is there whole or not at all."""
    with whole_file(path, "w") as file:
        file.write(json.dumps(value, indent=1))


def read_json(path: Path) -> dict[str, Any] | None:
    """Return what :func:`write_json` wrote, ``None`` where it did not."""
    return json.loads(path.read_text()) if path.is_file() else None
