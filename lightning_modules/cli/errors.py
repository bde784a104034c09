"""User errors, which the ``lightning`` command shows as one line."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from lightning_modules.cli.folder_lock import FolderError
from lightning_modules.pretrained import CheckpointMismatchError
from spikekit import SpikeFileError, VideoError
from spikekit.arguments import one_line
from spikekit.io import PictureError


class InputError(ValueError):
    """Something that the user gave and that cannot be used; shown as one line."""


@contextmanager
def as_one_line() -> Iterator[None]:
    """End the program with one line, and no traceback, where the user made a mistake."""
    try:
        yield
    except (InputError, SpikeFileError, PictureError, VideoError, CheckpointMismatchError, FolderError) as error:
        # what a worker of a loader raises comes with its traceback, whose last line it is
        said = str(error).strip().splitlines()[-1].split("Error: ", 1)[-1] if "Traceback (" in str(error) else error
        sys.exit(f"lightning: {said}")
    except OSError as error:
        if error.filename is None or isinstance(error, BrokenPipeError):
            raise
        sys.exit(f"lightning: {error.filename}: {one_line(error)}")
