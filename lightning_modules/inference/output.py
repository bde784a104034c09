"""Output of the pictures of a recording: a folder, a film or a single picture, written in parts and resumable."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

from spikekit import write_video
from spikekit.io.images import PictureError, png_bytes, png_pixels, to_bytes
from spikekit.io.quiet import quiet
from spikekit.io.video import VIDEO_ENDINGS
from spikekit.io.whole_file import write_whole
from spikekit.progress import progress

#: name of the lock file in a folder of pictures
LOCK = ".predict.lock"

_NOTE = "spikekit"  # PNG text with digests of a picture's inputs and pixels


def is_film(output: str | Path) -> bool:
    """Whether the path names a film rather than a folder of pictures."""
    return Path(output).suffix.lower() in (*VIDEO_ENDINGS, ".gif") and not Path(output).is_dir()


def is_picture(output: str | Path) -> bool:
    """Whether the path names a single picture rather than a folder of pictures."""
    return Path(output).suffix.lower() == ".png" and not Path(output).is_dir()


class Output:
    """Pictures in a folder, or a film or a single picture made from them.

    A picture is named after the spike frame that it shows, is written atomically, and holds a hash of its inputs.
    Pictures with the same inputs are not made again, so a run that was killed resumes after its last picture.

    Args:
        output: a folder; or a film, .mp4, .mov, .mkv or .gif, whose pictures are kept in a folder beside it until they
            are complete; or a .png file for a single picture.
        frames: spike frames to show, in order.
        made_of: everything that the pictures depend on, as plain values.

    Attributes:
        folder: folder of the pictures.
        state: path of the state of a film, see :meth:`Reconstruction.pictures`; a part adds its number.
    """

    def __init__(self, output: str | Path, frames: Sequence[int], made_of: dict[str, Any]) -> None:
        self.output = Path(output)
        self.is_file = is_film(output) or is_picture(output)
        self.folder = Path(f"{output}.frames") if self.is_file else self.output
        self._paths = {frame: self.folder / f"frame_{frame:06d}.png" for frame in frames}
        self._record = hashlib.sha256(json.dumps(made_of, sort_keys=True, default=str).encode()).hexdigest()
        self.state = self.folder / f".predict.state.{self._record[:16]}"
        if self.is_file and self.folder.is_symlink():  # in another user's folder it may lead anywhere
            raise PictureError(f"{self.folder}: expected a folder of pictures, got a link; choose another -o")
        if self.is_file:
            check_place(self.output, follow=True)
        for path in self._paths.values():
            _check_picture(path)

    def made(self) -> set[int]:
        """Return the frames whose pictures exist, are complete and have the same inputs."""
        return {frame for frame, path in self._paths.items() if self._is_there(path)}

    def _is_there(self, path: Path) -> bool:
        with suppress(Exception), quiet(), Image.open(path, formats=["PNG"]) as picture:
            record, _, pixels = picture.info[_NOTE].partition(" ")
            return record == self._record and pixels == _digest(png_pixels(path))
        return False

    def write(self, frame: int, rgb: Tensor) -> Path:
        """Write the picture of a frame, (3, H, W), and return its path."""
        path = self._paths[frame]
        if not rgb.sum().isfinite():  # saved, it would be black without explanation
            raise PictureError(f"{path}: expected finite values, got NaN from the network; the picture is not written")
        _check_picture(path)
        pixels = to_bytes(rgb).movedim(-1, 0)
        write_whole(path, png_bytes(pixels, {_NOTE: f"{self._record} {_digest(pixels)}"}))
        return path

    def finish(self, fps: float) -> None:
        """Write the film from its pictures, or move the single picture to its place."""
        if not self.is_file:
            return
        if is_film(self.output):
            pictures = (png_pixels(path) for path in self._paths.values())
            write_video(self.output, progress(pictures, "film", len(self._paths)), fps)
        else:
            (path,) = self._paths.values()
            path.replace(self.output)

    def clear(self) -> None:
        """Remove states, and the folder beside a film or a picture unless it holds other files."""
        for state in self.folder.glob("*.predict.state.*"):
            with suppress(OSError):
                state.unlink()
        if not self.is_file:
            return
        for path in self._paths.values():
            for own in (path, *self.folder.glob(f".{path.name}.*.part")):
                with suppress(OSError):
                    own.unlink()
        with suppress(OSError):
            (self.folder / LOCK).unlink()
            self.folder.rmdir()


def _digest(pixels: Tensor) -> str:
    return hashlib.sha256(pixels.movedim(0, -1).contiguous().numpy()).hexdigest()


def check_place(path: Path, follow: bool = False) -> None:
    """Check that a path is free or a file, or with ``follow``, for names that the user has given, a link to a file."""
    try:
        mode = os.stat(path, follow_symlinks=follow).st_mode
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(mode):
        kind = "a link" if stat.S_ISLNK(mode) else "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise PictureError(f"{path}: expected a file or nothing, got {kind}; choose another -o")


def _check_picture(path: Path) -> None:
    """Check that a path is free or a picture of ours, so that no other file is lost."""
    check_place(path)
    if path.exists():
        with suppress(Exception), quiet(), Image.open(path, formats=["PNG"]) as picture:
            if _NOTE in picture.info:
                return
        raise PictureError(f"{path}: expected a picture of lightning predict, got another file; choose another -o")
