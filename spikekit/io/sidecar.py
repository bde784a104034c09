"""Side-cars: JSON files that record how a simulated stream was made."""

from __future__ import annotations

import glob
import json
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spikekit.arguments import one_line
from spikekit.color.cfa import PATTERNS
from spikekit.io.failures import no_pipe, writing
from spikekit.io.whole_file import flush_folder, hidden_name

#: What the first line of a side-car says it is.
KIND = "spikekit simulation 1"


@dataclass(frozen=True)
class Sidecar:
    """What is known about a simulated stream; the values are those of JSON.

    Args:
        stream: ``file``, ``frames``, ``height``, ``width`` and ``sha256``, that of the frames as a ``.dat`` holds them.
        truth: pictures of the scene, by their path from the side-car: the frame of the stream at which each was seen.
        source: ``path``, from the side-car, and ``frames``: SHA-256 of the pixels of every frame that was looked at.
        settings: all that was asked for, or left at its default.
        plan: what was modelled.
        versions: of what computed it.
    """

    stream: dict[str, Any]
    truth: dict[str, float]
    source: dict[str, Any]
    settings: dict[str, Any]
    plan: dict[str, Any]
    versions: dict[str, str]

    def dumps(self) -> str:
        """Return the text of the file."""
        return json.dumps({"kind": KIND} | asdict(self), indent=1) + "\n"


def versions() -> dict[str, str]:
    """Return the versions of what a stream depends on."""
    from spikekit._version import __version__

    return {
        "spikekit": __version__,
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {torch.backends.cpu.get_cpu_capability()}",
    }


def read_sidecar(path: Path) -> Sidecar:
    """Read a side-car.

    Args:
        path: the file.

    Returns:
        What it says.

    Raises:
        ValueError: it cannot be read, or is something else; the message names it.
    """
    try:
        data = json.loads(no_pipe(path).read_text(encoding="utf-8"))
        if not isinstance(data, dict) or data.pop("kind", None) != KIND:
            raise ValueError(f"expected the side-car of a simulation ({KIND})")
        sidecar = Sidecar(**data)
        _check(sidecar)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        said = f"lacks {error}" if isinstance(error, KeyError) else one_line(error)[:300]
        raise ValueError(f"{path}: not a side-car that can be read ({said})") from error
    return sidecar


def _check(sidecar: Sidecar) -> None:
    """Raise unless the values are of the kinds that those who read them count on."""
    for name, part in vars(sidecar).items():
        if not isinstance(part, dict):
            raise ValueError(f"{name}: expected names and values, got {part!r}")
    stream, source, settings = sidecar.stream, sidecar.source, sidecar.settings
    sizes = [stream[key] for key in ("frames", "height", "width")]
    if not all(map(_is_whole, sizes)):
        raise ValueError(f"expected frames, height and width above 0, got {sizes}")
    texts = {"file": stream["file"], "sha256": stream["sha256"], "path": source["path"]}
    for name, value in texts.items():
        if not isinstance(value, str):
            raise ValueError(f"{name}: expected a text, got {value!r}")
    if not isinstance(source["frames"], dict) or not source["frames"]:
        raise ValueError(f"frames of the source: expected names and values, got {source['frames']!r}")
    for name, (expected, is_good) in _SETTINGS.items():
        if name in settings and not is_good(settings[name]):
            raise ValueError(f"{name}: expected {expected}, got {settings[name]!r}")


def _is_whole(value: Any, least: int = 1) -> bool:
    return type(value) is int and least <= value < 1 << 31  # True is an int, and JSON's have no end


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= sys.float_info.max


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


def _is_noise(value: Any) -> bool:
    known = isinstance(value, dict) and value.get("calibration") is None  # that is a file, of the settings
    return known and all(one is None or _is_number(one) for one in value.values())


_WHOLE = ("a whole number, 1 or more", _is_whole)
# a minute of a camera between two frames; a few bytes could ask for a stream that never ends
_CLOCKS = (f"a whole number, 1 .. {1 << 20}", lambda value: _is_whole(value) and value <= 1 << 20)
_POSITIVE = ("a finite number above 0", _is_positive)

# Of the settings that something is computed from: what to expect, and whether a value is that.
_SETTINGS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "scale": _WHOLE,
    "pattern": (f"one of {', '.join(PATTERNS)}", lambda value: value in PATTERNS),
    "alpha": _POSITIVE,
    "clocks": _CLOCKS,
    "frame": ("a whole number, 0 or more, or null", lambda value: value is None or _is_whole(value, 0)),
    "frames": ("a whole number, 1 or more, or null", lambda value: value is None or _is_whole(value)),
    "readout": _CLOCKS,
    "seed": ("a whole number, 0 or more", lambda value: type(value) is int and value >= 0),
    "plan": ("a text or a number of latent frames", lambda value: isinstance(value, str) or _is_whole(value, 0)),
    "tolerance": _POSITIVE,
    "step": _POSITIVE,
    "interpolation": ("a text", lambda value: isinstance(value, str)),
    "noise": ("names and finite numbers", _is_noise),
    "calibration": ("a text or null", lambda value: value is None or isinstance(value, str)),
}


def find_sidecar(stream: Path) -> Sidecar | None:
    """Return the side-car of a stream: the JSON file of the same name, where it speaks of this file.

    Args:
        stream: a recording.

    Returns:
        The side-car; ``None`` where there is none, or that of another stream.

    Raises:
        ValueError: it speaks of this file, but not as a side-car does; the message names it.
    """
    path = stream.with_suffix(".json")
    try:
        sidecar = read_sidecar(path)
    except ValueError:
        if _claims(path, stream):
            raise
        return None
    return sidecar if sidecar.stream["file"] == stream.name else None


def check_unclaimed(outputs: Iterable[Path], stream: Path) -> None:
    """Refuse to write over what a side-car names: that of the stream, or one beside an output.

    Args:
        outputs: what is to be written.
        stream: the recording that they show.

    Raises:
        ValueError: a side-car names an output as its stream or its ground truth; the message names both.
    """
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


def _claims(path: Path, stream: Path) -> bool:
    """Return whether a damaged side-car still says that it is that of a stream."""
    try:
        data = json.loads(no_pipe(path).read_text(encoding="utf-8"))
        return data["kind"] == KIND and data["stream"]["file"] == stream.name
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return False


@contextmanager
def published(output: Path) -> Iterator[Path]:
    """Give a folder to write to; when all is written, put everything under its final name, the side-car last.

    Convention:
        The folder lies beside ``output``, hidden. Its contents move to where ``output`` is, each by one renaming, and
        the side-car, ``output`` with the ending ``.json``, after all others. One that is there already and says
        something else goes first. So a stream beside its side-car is complete, whenever the process was killed. What
        remains of one that was is a hidden folder that ends in ``.part``, which the next one removes.

        Processes that write the same output publish one after the other.

    Args:
        output: the stream.

    Returns:
        A context that yields the folder.

    Raises:
        ValueError: the folder cannot be made, something cannot be moved, or the place of the side-car is taken by
            something else.
    """
    target, last, hidden = output.parent, output.with_suffix(".json"), hidden_name(output.name)
    if last.exists():
        stream = read_sidecar(last).stream["file"]  # raises where the file is something else
        if stream != output.name:
            raise ValueError(f"{output}: its side-car, {last}, would replace that of {stream}; choose another name")
    with ExitStack() as stack:
        with writing(output):
            target.mkdir(parents=True, exist_ok=True)
            with _locked(target):
                for other in target.glob(f"{glob.escape(hidden)}.*.part"):
                    with _locked(other, wait=False) as dead:
                        if dead:
                            shutil.rmtree(other, ignore_errors=True)
                part = Path(tempfile.mkdtemp(".part", f"{hidden}.", target))
                stack.callback(shutil.rmtree, part, ignore_errors=True)
                stack.enter_context(_locked(part))
        yield part
        try:
            with _locked(target):
                _publish(part, target, last.name)
        except OSError as error:
            raise ValueError(f"{error.filename2 or output}: cannot be written ({error.strerror or error})") from error


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
    if sidecar.is_file() and sidecar.read_bytes() != (part / last).read_bytes():
        sidecar.unlink()
    folders = {target}
    for path in files:
        final = target / path.relative_to(part)
        final.parent.mkdir(exist_ok=True)
        folders.add(final.parent)
        if path == part / last:  # the others have to be on the disk before it says that they are
            for folder in folders:
                flush_folder(folder)
        os.replace(path, final)
    flush_folder(target)


@contextmanager
def _locked(folder: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold the lock of a folder, which ends with the process; yields whether it is held."""
    with ExitStack() as stack:
        held = False
        with suppress(OSError, ImportError):  # not every system and not every file system has locks
            import fcntl

            handle = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, handle)
            fcntl.flock(handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            held = True
        yield held
