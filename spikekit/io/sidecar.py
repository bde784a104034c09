"""Side-cars: JSON files that record how a simulated stream was made."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spikekit.arguments import one_line
from spikekit.check import check_positive, check_whole
from spikekit.color.cfa import GREY, PATTERNS
from spikekit.io.failures import no_pipe
from spikekit.io.whole_file import flush_folder, hidden_name

#: Kind and version of the format, stored in the file.
KIND = "spikekit simulation 1"


@dataclass(frozen=True)
class Sidecar:
    """Description of a simulated stream, in JSON types. Paths are relative to the side-car."""

    stream: dict[str, Any]  # file, frames, height, width, and sha256 of the frames in the layout of a .dat
    truth: dict[str, float]  # path of each ground truth: its frame in the stream
    source: dict[str, Any]  # path, and names of the frames that were read
    settings: dict[str, Any]  # all settings, defaults included
    plan: dict[str, Any]  # what was modelled
    versions: dict[str, str]  # of the software

    def __post_init__(self) -> None:
        for part, values in vars(self).items():
            if not isinstance(values, dict):
                raise ValueError(f"{part}: expected names and values, got {values!r}")
        if not isinstance(self.stream["file"], str):
            raise ValueError(f"stream.file: expected a string, got {self.stream['file']!r}")
        for name in ("frames", "height", "width"):
            check_whole(f"stream.{name}", self.stream[name])
        alpha, pattern = self.settings.get("alpha", 1.0), self.settings.get("pattern", "RGGB")
        if type(alpha) not in (int, float):
            raise ValueError(f"settings.alpha: expected a number, got {alpha!r}")
        check_positive("settings.alpha", float(alpha))
        if pattern not in (*PATTERNS, GREY):
            raise ValueError(f"settings.pattern: expected one of {', '.join(PATTERNS)}, {GREY}, got {pattern!r}")

    def dumps(self) -> str:
        """Return the text of the file."""
        return json.dumps({"kind": KIND} | asdict(self), indent=1) + "\n"


def read_sidecar(path: Path) -> Sidecar:
    """Read a side-car; raise a ValueError that names it if it is unreadable or another file."""
    try:
        return Sidecar(**_data(path))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        said = f"lacks {error}" if isinstance(error, KeyError) else one_line(error)[:300]
        raise ValueError(f"{path}: not a readable side-car ({said})") from error


def _data(path: Path) -> dict[str, Any]:
    data = json.loads(no_pipe(path).read_text(encoding="utf-8"))
    if not isinstance(data, dict) or data.pop("kind", None) != KIND:
        raise ValueError(f"expected the side-car of a simulation ({KIND})")
    return data


def find_sidecar(stream: Path) -> Sidecar | None:
    """Return the side-car of a stream: the JSON file of the same name, if it describes this stream."""
    path, ours = stream.with_suffix(".json"), False
    with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
        ours = _data(path)["stream"]["file"] == stream.name
    return read_sidecar(path) if ours else None


def check_unclaimed(outputs: Iterable[Path], stream: Path) -> None:
    """Raise a ValueError if an output would overwrite a stream or a ground truth named by a side-car nearby."""
    wanted = {output.resolve(): output for output in outputs}
    near = (place for output in wanted for place in (output, output.parent) if place.name)
    for path in dict.fromkeys(place.with_suffix(".json") for place in (stream.resolve(), *near)):
        try:
            sidecar = read_sidecar(path)
        except ValueError:
            continue
        for name in (sidecar.stream["file"], *sidecar.truth):
            output = wanted.get((path.parent / name).resolve())
            if output is not None:
                kind = "ground truth" if name in sidecar.truth else "stream"
                raise ValueError(f"{output}: would overwrite the {kind} of {path.name}; choose another name")


@contextmanager
def published(output: Path) -> Iterator[Path]:
    """Yield a temporary folder; at the end, move its files to their final names, the side-car last.

    Convention:
        The temporary folder is hidden and lies beside ``output``. Its files are renamed one by one, and last the
        side-car, which is ``output`` with the ending ``.json``. An old side-car is removed first. A stream with a
        side-car is therefore complete, even if a process was killed. A killed process leaves a hidden folder that ends
        in ``.part``; the next run empties it. Processes with the same output run one after the other.

    Raises:
        ValueError: another file has the name of the side-car or of a picture.
        OSError: a file cannot be written; the error names the output.
    """
    target, sidecar = output.parent, output.with_suffix(".json")
    if sidecar.exists():
        stream = read_sidecar(sidecar).stream["file"]  # raises if it is not a side-car
        if stream != output.name:
            raise ValueError(f"{output}: its side-car {sidecar} would overwrite that of {stream}; choose another name")
    target.mkdir(parents=True, exist_ok=True)
    part = target / f"{hidden_name(sidecar.name)}.part"
    try:
        with _owned(part) as part:
            yield part
            _publish(part, target, sidecar.name)
    except OSError as error:
        name = error.filename2 or error.filename or output
        error.filename = str(Path(str(name).replace(str(part), str(target))))
        raise


@contextmanager
def _owned(place: Path) -> Iterator[Path]:
    """Wait for the lock of ``place``, yield an empty folder in it, and remove both at the end."""
    with ExitStack() as stack:
        while True:
            place.mkdir(exist_ok=True)
            try:
                import fcntl

                handle = os.open(place, os.O_RDONLY | os.O_NOFOLLOW)
                stack.callback(os.close, handle)
                fcntl.flock(handle, fcntl.LOCK_EX)
                if os.path.samestat(os.fstat(handle), os.stat(place)):
                    for left in place.iterdir():  # leftovers of a killed process
                        shutil.rmtree(left)
                    break
            except FileNotFoundError:  # another process has just removed it
                pass
            except (OSError, ImportError):  # no locks on this system or file system
                break
        folder = Path(tempfile.mkdtemp(dir=place))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            with suppress(OSError):  # other processes use it
                place.rmdir()


def _publish(part: Path, target: Path, last: str) -> None:
    sidecar = target / last
    files = sorted((path for path in part.rglob("*") if path.is_file()), key=lambda path: path == part / last)
    known = read_sidecar(sidecar).truth if sidecar.is_file() else {}
    for path in files:  # do not overwrite other pictures, unless they are equal, as after a killed process
        name = path.relative_to(part)
        final = target / name
        if name.parent.name and final.parent.is_symlink():  # could lead anywhere
            raise ValueError(f"{final.parent}: expected a folder, got a link; choose another name")
        taken = name.suffix == ".png" and name.as_posix() not in known and final.exists()
        if taken and not (final.is_file() and final.read_bytes() == path.read_bytes()):
            raise ValueError(f"{final}: exists and is not a ground truth of {last}; choose another name")
    sidecar.unlink(missing_ok=True)
    for path in files:
        final = target / path.relative_to(part)
        final.parent.mkdir(exist_ok=True)
        if path == part / last:  # all other files must be on disk before the side-car
            for folder in {(target / other.relative_to(part)).parent for other in files}:
                flush_folder(folder)
        os.replace(path, final)
    flush_folder(target)
