"""Where pictures of a recording go: a folder, a film or a single picture; made in parts, and resumed."""

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
from spikekit.io.image_bytes import PictureError, png_bytes, png_pixels
from spikekit.io.quiet import quiet
from spikekit.io.video import VIDEO_ENDINGS
from spikekit.io.whole_file import whole_file
from spikekit.progress import progress

#: name of the file that is locked while pictures are made
LOCK = ".predict.lock"

_NOTE = "spikekit"  # of a picture, which says of what it was made


def is_film(output: str | Path) -> bool:
    """Whether this names a film rather than a folder of pictures."""
    return Path(output).suffix.lower() in (*VIDEO_ENDINGS, ".gif") and not Path(output).is_dir()


def is_picture(output: str | Path) -> bool:
    """Whether this names a single picture rather than a folder of them."""
    return Path(output).suffix.lower() == ".png" and not Path(output).is_dir()


class Output:
    """Pictures in a folder, which become a film or a single picture where that is asked for.

    A picture is named after the spike frame that it shows, appears when it is whole, and says of what it was made. What
    is there already, made of the same, need not be made again: a run that was killed resumes behind its last picture.

    Args:
        output: a folder; or a film, .mp4, .mov, .mkv or .gif, whose pictures lie in a folder beside it until they are
            complete; or a .png, where there is one picture.
        frames: spike frames that are shown, in order.
        made_of: all that pictures depend on, as plain values.

    Attributes:
        folder: of the pictures.

    Raises:
        PictureError: the place of a picture is taken by a link, a pipe, a folder, or a file of somebody else.
    """

    def __init__(self, output: str | Path, frames: Sequence[int], made_of: dict[str, Any]) -> None:
        self.output = Path(output)
        self.is_file = is_film(output) or is_picture(output)
        self.folder = Path(f"{output}.frames") if self.is_file else self.output
        self._paths = {frame: self.folder / f"frame_{frame:06d}.png" for frame in frames}
        self._record = hashlib.sha256(json.dumps(made_of, sort_keys=True, default=str).encode()).hexdigest()
        if self.is_file and self.folder.is_symlink():  # in a stranger's folder it may lead anywhere
            raise PictureError(f"{self.folder}: expected a folder of pictures, got a link; -o goes elsewhere")
        if self.is_file:
            check_place(self.output, follow=True)
        for path in self._paths.values():
            _check_picture(path)

    def made(self) -> set[int]:
        """Return the frames whose pictures are there, made of the same, and whole."""
        return {frame for frame, path in self._paths.items() if self._is_there(path)}

    def _is_there(self, path: Path) -> bool:
        with suppress(Exception), quiet(), Image.open(path, formats=["PNG"]) as picture:
            if picture.info.get(_NOTE) == self._record:
                picture.verify()  # the check sums of all its parts
                return True
        return False

    def write(self, frame: int, rgb: Tensor) -> Path:
        """Write the picture of a frame, (3, H, W), and return where."""
        path = self._paths[frame]
        if not rgb.isfinite().all():  # it would be black there, and nothing would say why
            raise PictureError(f"{path}: expected a picture, the network makes NaN of this clip; nothing is written")
        _check_picture(path)
        with whole_file(path) as file:
            file.write(png_bytes(rgb, {_NOTE: self._record}))
        return path

    def finish(self, fps: float) -> None:
        """Lay the pictures to a film, or put the only one in its place, and remove what was written on the way."""
        if not self.is_file:
            return
        if is_film(self.output):
            pictures = (png_pixels(path) for path in self._paths.values())
            write_video(self.output, progress(pictures, "film", len(self._paths)), fps)
        else:
            (path,) = self._paths.values()
            path.replace(self.output)

    def clear(self) -> None:
        """Remove the folder beside a film or a picture; what others have put there stays, and the folder with it."""
        if not self.is_file:
            return
        for path in self._paths.values():
            for own in (path, *self.folder.glob(f".{path.name}.*.part")):
                with suppress(OSError):
                    own.unlink()
        with suppress(OSError):
            (self.folder / LOCK).unlink()
            self.folder.rmdir()


def check_place(path: Path, follow: bool = False) -> None:
    """Refuse to write into a pipe or, where a name is ours and not the user's, through a link.

    Args:
        path: where a file is to be.
        follow: whether a link may lead to it.

    Raises:
        PictureError: it is taken.
    """
    try:
        mode = os.stat(path, follow_symlinks=follow).st_mode
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(mode):
        kind = "a link" if stat.S_ISLNK(mode) else "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise PictureError(f"{path}: expected a file or nothing, got {kind}; -o goes elsewhere")


def _check_picture(path: Path) -> None:
    """Refuse to write a picture where there is something else; it would be lost."""
    check_place(path)
    if path.exists():
        with suppress(Exception), quiet(), Image.open(path, formats=["PNG"]) as picture:
            if _NOTE in picture.info:
                return
        raise PictureError(f"{path}: expected a picture of lightning predict, got another file; -o goes elsewhere")


def file_identity(path: str | Path) -> list[Any]:
    """Return what tells a file from another, and from itself after it has changed."""
    path = Path(path).resolve()
    return [str(path), path.stat().st_size, path.stat().st_mtime_ns]
