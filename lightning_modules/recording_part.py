"""``python -m lightning_modules.recording_part ARGS``: ``lightning ARGS``, which ends when its parent process does."""

from __future__ import annotations

import sys

from lightning_modules.__main__ import main
from lightning_modules.cli.processes import end_with_parent

if __name__ == "__main__":
    end_with_parent()
    arguments, sys.argv = sys.argv[1:], sys.argv[:1]
    main(arguments)
