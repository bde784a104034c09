"""Side-cars: JSON files that record how a simulated stream was made."""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spikekit.arguments import one_line
from spikekit.color.cfa import PATTERNS
from spikekit.io.failures import no_pipe
from spikekit.io.whole_file import flush_folder, hidden_name

#: What the first line of a side-car says it is.
KIND = "spikekit simulation 1"


@dataclass(frozen=True)
class Sidecar:
    """What is known about a simulated stream; the values are those of JSON."""

    stream: dict[str, Any]  # file, frames, height, width and sha256, that of the frames as a .dat holds them
    truth: dict[str, float]  # pictures, by their path from the side-car: the frame of the stream at which each was seen
    source: dict[str, Any]  # path, and the names of the frames that were looked at
    settings: dict[str, Any]  # all that was asked for, or left at its default
    plan: dict[str, Any]  # what was modelled
    versions: dict[str, str]  # of what computed it

    def dumps(self) -> str:
        """Return the text of the file."""
        return json.dumps({"kind": KIND} | asdict(self), indent=1) + "\n"


def read_sidecar(path: Path) -> Sidecar:
    """Read a side-car; raise ValueError, which names it, where it cannot be read or is something else."""
    try:
        sidecar = Sidecar(**_data(path))
        _check(sidecar)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        said = f"lacks {error}" if isinstance(error, KeyError) else one_line(error)[:300]
        raise ValueError(f"{path}: not a side-car that can be read ({said})") from error
    return sidecar


def _data(path: Path) -> dict[str, Any]:
    data = json.loads(no_pipe(path).read_text(encoding="utf-8"))
    if not isinstance(data, dict) or data.pop("kind", None) != KIND:
        raise ValueError(f"expected the side-car of a simulation ({KIND})")
    return data


def _check(sidecar: Sidecar) -> None:
    """Raise unless the values are of the kinds that those who read them count on."""
    for part, values in vars(sidecar).items():
        if not isinstance(values, dict):
            raise ValueError(f"{part}: expected names and values, got {values!r}")
        for name, (expected, is_good) in _VALUES.get(part, {}).items():
            if (part != "settings" or name in values) and not is_good(values[name]):
                raise ValueError(f"{part}.{name}: expected {expected}, got {values[name]!r}")


def _is_whole(value: Any) -> bool:
    return type(value) is int and 1 <= value < 1 << 31  # True is an int, and JSON's have no end


_TEXT = ("a text", lambda value: isinstance(value, str))
_WHOLE = ("a whole number, 1 or more", _is_whole)

# What to expect of what is read again, and whether a value is that.
_VALUES: dict[str, dict[str, tuple[str, Callable[[Any], bool]]]] = {
    "stream": {"file": _TEXT, "sha256": _TEXT, "frames": _WHOLE, "height": _WHOLE, "width": _WHOLE},
    "settings": {
        "pattern": (f"one of {', '.join(PATTERNS)}", lambda value: value in PATTERNS),
        "alpha": (
            "a finite number above 0",
            lambda value: type(value) in (int, float) and 0 < value <= sys.float_info.max,
        ),
    },
}


def find_sidecar(stream: Path) -> Sidecar | None:
    """Return the side-car of a stream: the JSON file of the same name, where it speaks of this file.

    Raises:
        ValueError: it speaks of this file, but not as a side-car does; the message names it.
    """
    path, ours = stream.with_suffix(".json"), False
    with suppress(OSError, ValueError, TypeError, LookupError, RecursionError):
        ours = _data(path)["stream"]["file"] == stream.name
    return read_sidecar(path) if ours else None


def check_unclaimed(outputs: Iterable[Path], stream: Path) -> None:
    """Refuse to write over what a side-car names, that of the stream or one beside an output: a ValueError says so."""
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
                raise ValueError(f"{output}: the {kind} of {path.name} would be lost; choose another name")


@contextmanager
def published(output: Path) -> Iterator[Path]:
    """Give a folder to write to; when all is written, put everything under its final name, the side-car last.

    Convention:
        The folder lies beside ``output``, hidden. Its contents move to where ``output`` is, each by one renaming, and
        the side-car, ``output`` with the ending ``.json``, after all others. One that is there already goes first. So a
        stream beside its side-car is complete, whenever the process was killed. What remains of one that was is a
        hidden folder that ends in ``.part``, which the next one empties. Processes that write the same output do so one
        after the other.

    Raises:
        ValueError: the place of the side-car or of a picture is taken by something else.
        OSError: something cannot be written; it names the output.
    """
    target, sidecar = output.parent, output.with_suffix(".json")
    if sidecar.exists():
        stream = read_sidecar(sidecar).stream["file"]  # raises where the file is something else
        if stream != output.name:
            raise ValueError(f"{output}: its side-car, {sidecar}, would replace that of {stream}; choose another name")
    target.mkdir(parents=True, exist_ok=True)
    with _owned(target / f"{hidden_name(sidecar.name)}.part") as part:
        try:
            yield part
            _publish(part, target, sidecar.name)
        except OSError as error:
            name = error.filename2 or error.filename or output
            error.filename = str(Path(str(name).replace(str(part), str(target))))
            raise


@contextmanager
def _owned(place: Path) -> Iterator[Path]:
    """Give an empty folder in one that nobody else has, as soon as whoever has it is done; remove both at the end."""
    with ExitStack() as stack:
        while True:
            place.mkdir(exist_ok=True)
            try:
                import fcntl

                handle = os.open(place, os.O_RDONLY | os.O_NOFOLLOW)
                stack.callback(os.close, handle)
                fcntl.flock(handle, fcntl.LOCK_EX)
                if os.path.samestat(os.fstat(handle), os.stat(place)):
                    for left in place.iterdir():  # by a process that was killed
                        shutil.rmtree(left)
                    break
            except FileNotFoundError:  # somebody was done
                pass
            except (OSError, ImportError):  # not every system and not every file system has locks
                break
        folder = Path(tempfile.mkdtemp(dir=place))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            with suppress(OSError):  # others are waiting, or at work
                place.rmdir()


def _publish(part: Path, target: Path, last: str) -> None:
    sidecar = target / last
    files = sorted((path for path in part.rglob("*") if path.is_file()), key=lambda path: path == part / last)
    known = read_sidecar(sidecar).truth if sidecar.is_file() else {}
    for path in files:  # pictures of others are not replaced; what a killed process has left is the same
        name = path.relative_to(part)
        final = target / name
        if name.parent.name and final.parent.is_symlink():  # whoever made the folder chose where it leads
            raise ValueError(f"{final.parent}: expected a folder of its own, got a link; choose another name")
        taken = name.suffix == ".png" and name.as_posix() not in known and final.exists()
        if taken and not (final.is_file() and final.read_bytes() == path.read_bytes()):
            raise ValueError(f"{final}: would be lost, and is no ground truth of {last}; choose another name")
    sidecar.unlink(missing_ok=True)
    for path in files:
        final = target / path.relative_to(part)
        final.parent.mkdir(exist_ok=True)
        if path == part / last:  # the others have to be on the disk before it says that they are
            for folder in {(target / other.relative_to(part)).parent for other in files}:
                flush_folder(folder)
        os.replace(path, final)
    flush_folder(target)
