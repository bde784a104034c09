"""Folder layouts of video data sets: REDS, Vid4, Vimeo-90K, or any folder of frame folders."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from lightning_modules.data.pictures import existing_folder
from spikekit.io.video import PICTURE_ENDINGS, natural_order

#: description of the layouts, for messages
EXPECTED = """\
  REDS 120 fps   train/train_orig/000/00000000.png ...    240 scenes (train_orig_part0.zip to part15.zip)
                 val/val_orig/000/00000000.png ...        30 scenes (val_orig_part0.zip and part1.zip)
  Vid4           GT/calendar/00000000.png ...             calendar, city, foliage, walk
  Vimeo-90K      sequences/00001/0001/im1.png ... im7.png
                 sep_trainlist.txt, sep_testlist.txt
    or its       low_resolution/00001/0266/im1.png ... im7.png
    test set     target/00001/0266/im4.png, sep_testlist.txt
  other films    NAME/FRAME.png ...                       one folder of frames for each film"""

_VID4 = ("calendar", "city", "foliage", "walk")

# places of the REDS scenes: archives unpacked together or into separate folders, or root one folder further down
_REDS = ("{0}/{0}_orig", "{0}_orig", "{0}_orig_part*/{0}/{0}_orig", "{0}_orig_part*/{0}_orig", "{0}")


@dataclass(frozen=True)
class SequenceFiles:
    """The files of a frame sequence, such as ``walk`` or ``00001/0266``.

    The ground truth, of the same file names, is in the folder ``truth``, by default that of the frames. The sensor sees
    frames reduced by the factor ``shrink``. ``middle`` is the only frame that may be the middle of a clip.
    """

    name: str
    folder: Path
    frames: tuple[str, ...]
    truth: Path | None = None
    shrink: int = 1
    middle: int | None = None


@dataclass(frozen=True)
class Collection:
    """Sequences of a data set; clips per sequence, as in the paper; and the only factor that they support, if any."""

    name: str
    train: tuple[SequenceFiles, ...] = ()
    val: tuple[SequenceFiles, ...] = ()
    test: tuple[SequenceFiles, ...] = ()
    clips: int = 1
    scale: int | None = None


def find_sequences(root: str | Path, hold_out: Callable[[list], tuple[list, list]]) -> Collection:
    """Recognise the data set in a folder by its files; frames are not opened.

    The archives of a data set were unpacked into the folder, or into the one above. ``hold_out`` splits sequences
    without an official split into training and validation. Error messages show the expected layouts.
    """
    root = existing_folder(root, "films")
    found = _reds(root) or _vimeo(root) or _vid4(root) or _others(root, hold_out)
    if found is None:
        raise FileNotFoundError(f"{root}: no films in this folder; expected one of\n{EXPECTED}")
    return found


def _reds(root: Path) -> Collection | None:
    train, val = (
        _films(folder for pattern in _REDS for folder in sorted(root.glob(pattern.format(split))))
        for split in ("train", "val")
    )
    return Collection("REDS", train, val, val, clips=5) if train or val else None


def _vid4(root: Path) -> Collection | None:
    films = _films([root / "GT"])
    if not films:
        films = _films([root])
        if not films or any(film.name not in _VID4 for film in films):
            return None
    return Collection("Vid4", val=films, test=films)


def _others(root: Path, hold_out: Callable[[list], tuple[list, list]]) -> Collection | None:
    films = _films([root]) or _films([root.parent], only=root.name)
    if not films:
        return None
    train, val = hold_out(list(films))
    return Collection("films", tuple(train), tuple(val), films, clips=5)


def _vimeo(root: Path) -> Collection | None:
    train = test = ()
    for folder in (root, root / "vimeo_septuplet"):
        if (folder / "sequences").is_dir():
            matlab = folder.with_name("vimeo_septuplet_matlabLRx4") / "sequences"
            small = next(filter(Path.is_dir, (folder / "BIx4", folder / "low_resolution", matlab)), None)
            train, test = (_septuplets(folder, small, f"sep_{split}list.txt") for split in ("train", "test"))
            break
    for folder in (root, root / "vimeo_super_resolution_test"):
        if (folder / "low_resolution").is_dir() and (folder / "target").is_dir():
            test = _septuplets(folder, folder / "low_resolution", "sep_testlist.txt", "target")
    return Collection("Vimeo-90K", train, test, test, scale=4) if train or test else None


def _septuplets(folder: Path, small: Path | None, listed: str, large: str = "sequences") -> tuple[SequenceFiles, ...]:
    """Return the sequences of a list file with lines such as ``00001/0001``."""
    if not (folder / listed).is_file():
        return ()
    try:
        names = (folder / listed).read_text(encoding="utf-8").split()
    except ValueError as error:
        raise ValueError(f"{folder / listed}: expected a list of sequences ({error})") from error
    parents = sorted({name.partition("/")[0] for name in names})
    for place in filter(None, (small, folder / large)):
        # lists 96 parent folders instead of checking 91,701 sequences
        there = {f"{parent}/{name}" for parent in parents for name in _subfolders(place / parent)}
        missing = [name for name in names if name not in there]
        if missing:
            raise FileNotFoundError(
                f"{folder / listed}: {len(missing)} of {len(names)} sequences are not in {place}, the first is "
                f"{missing[0]}; expected\n{EXPECTED}"
            )
    frames = tuple(f"im{n}.png" for n in range(1, 8))
    return tuple(
        SequenceFiles(
            name, (small or folder / large) / name, frames, folder / large / name, 1 if small else 4, middle=3
        )
        for name in names
    )


def _films(folders: Iterable[Path], only: str | None = None) -> tuple[SequenceFiles, ...]:
    """Return the subfolders with pictures, as films."""
    films: dict[str, SequenceFiles] = {}
    for folder in folders:
        for name in [only] if only else _subfolders(folder):
            seen = (frame for frame in os.listdir(folder / name) if not frame.startswith("."))
            frames = sorted((one for one in seen if Path(one).suffix.lower() in PICTURE_ENDINGS), key=natural_order)
            if frames:
                films.setdefault(name, SequenceFiles(name, folder / name, tuple(frames)))
    return tuple(films[name] for name in sorted(films, key=natural_order))


def _subfolders(folder: Path) -> list[str]:
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        return [entry.name for entry in entries if os.path.isdir(entry.path) and not entry.name.startswith(".")]
