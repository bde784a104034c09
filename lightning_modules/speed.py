"""From a wish, how fast or within which budget, to a setting: read off the table that comes with the weights."""

from __future__ import annotations

import csv
import re
import shlex
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from lightning_modules.tiles import FAR, HALO, TILE
from spikekit.bench.measure import timer_of

_FOLDER = Path(__file__).parent / "weights"

#: how far a speed may be below the best, in dB of the table
SPEEDS = {"fastest": float("inf"), "fast": 1.2, "balanced": 0.3, "best": 0.005}

#: times this close cannot be told apart, and the better setting is picked
_AS_FAST = 1.1

#: MiB a sensor pixel that an estimate of motion takes, which is made on the whole frame: ClassicalFlow's, measured
_MOTION = 240 / 2**20

_UNITS = {
    "ms": ("ms", 1.0),
    "s": ("ms", 1e3),
    "MB": ("mib", 1e6 / 2**20),
    "GB": ("mib", 1e9 / 2**20),
    "MiB": ("mib", 1.0),
    "GiB": ("mib", 1024.0),
}


@dataclass(frozen=True)
class Choice:
    """A setting that was measured.

    Args:
        name: what it is called.
        args: arguments of ``lightning predict`` that make it.
        psnr: dB, on the clips of the table.
        below: dB below the best of the table.
        ms: expected for a frame.
        mib: memory, expected for a frame.
        where: on which machine.
    """

    name: str
    args: tuple[str, ...]
    psnr: float
    below: float
    ms: float
    mib: float
    where: str = "on the machine of the table"

    def __str__(self) -> str:
        cost = f"about {self.ms:.3g} ms and {self.mib:.3g} MiB a frame {self.where}"
        return f"{self.name}: {cost}, {self.below:.2f} dB below the best"


def choices(scale: int, size: tuple[int, int]) -> list[Choice]:
    """Return the settings of the table for a scale that are arguments of the model alone, fastest first.

    Time is taken to grow with the number of pixels; times are the table's ratios, taken times that of its first
    setting. Memory grows with them, too, until a tile is full, with all that motion may reach over; from there on only
    by what the leanest setting takes, such as the picture itself, and by an estimate of motion. A setting without tiles
    is left out: on recordings larger than the table's clips its memory has no bound, and on the clips themselves it is
    the first one.

    Args:
        scale: super-resolution factor.
        size: of a frame, (H, W) in sensor pixels.

    Raises:
        ValueError: no table comes with the package for this scale.
    """
    rows = _table(scale)
    frame = min(float(row["mib"]) for row in rows)
    found = []
    for row in rows:
        args = tuple(shlex.split(row["arguments"]))
        of_the_model = all(word.startswith("--model.") for word in args if word.startswith("-"))  # precision is not
        if of_the_model and "--model.tile 0" not in row["arguments"]:
            measured = int(row["height"]) * int(row["width"])
            pixels = size[0] * size[1] / measured
            tile = int(args[args.index("--model.tile") + 1]) if "--model.tile" in args else TILE
            in_tile = min(pixels, (tile + 2 * (HALO + FAR)) ** 2 / measured)
            psnr, ratio, mib = (float(row[name]) for name in ("psnr", "ratio", "mib"))
            moves = "ZeroFlow" not in args and "ClassicalDecoder" not in args
            everywhere = frame + moves * _MOTION * measured
            mib = everywhere * pixels + (mib - everywhere) * in_tile
            found.append(Choice(row["setting"], args, psnr, 0.0, ratio * float(rows[0]["ms"]) * pixels, mib))
    best = max(choice.psnr for choice in found)
    found = [replace(choice, below=best - choice.psnr) for choice in found]
    return sorted(found, key=lambda choice: choice.ms)


def _table(scale: int) -> list[dict[str, str]]:
    path = _FOLDER / f"x{scale}.csv"
    if not path.is_file():
        there = ", ".join(sorted(path.stem for path in _FOLDER.glob("x*.csv"))) or "none"
        raise ValueError(f"scale: expected one that was measured ({there}), got {scale}")
    with open(path, newline="") as file:
        return [row for row in csv.DictReader(file) if not row["failed"]]


def pace(scale: int) -> float:
    """Measure how many times longer a frame takes here than in the table: its first setting, on a quarter of a clip.

    Args:
        scale: super-resolution factor.

    Returns:
        1 on the machine of the table, 2 on one that takes twice as long.
    """
    from lightning_modules.module import SuperResolution, make_module  # which chooses from here

    row = _table(scale)[0]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    module = make_module(SuperResolution, shlex.split(row["arguments"])).eval().to(device)
    height, width = int(row["height"]) // 2, int(row["width"]) // 2
    spikes = torch.rand(1, module.network.frames, height, width, device=device) < module.network.settings["alpha"] / 2
    timer, _ = timer_of(device, torch.get_num_threads())
    module(spikes)
    return 4e3 * timer(lambda: module(spikes), 3) / float(row["ms"])


def choose(
    scale: int, speed: str | None = None, budget: str | None = None, size: tuple[int, int] = (250, 400)
) -> Choice:
    """Pick the setting that serves best.

    For a budget of time this machine is tried first, for a second or so, and the times of the table are taken times
    :func:`pace`.

    Args:
        scale: super-resolution factor.
        speed: ``"best"``, ``"balanced"`` and ``"fast"``, the fastest at most 0.005, 0.3 and 1.2 dB below the most
            exact, or ``"fastest"``; of those within 10 % of its time the most exact.
        budget: instead, what a frame may take: a time, such as ``"40ms"``, or memory, such as ``"200MB"``. Of what fits
            it is the best.
        size: of a frame, (H, W) in sensor pixels, which a budget depends on.

    Raises:
        ValueError: an unknown speed, a budget that cannot be read or that nothing fits, a scale without a table.

    Example:
        >>> choose(4, "fastest").ms <= choose(4, "best").ms
        True
        >>> choose(4, budget="1h")
        Traceback (most recent call last):
            ...
        ValueError: budget: expected a time or memory, such as 40ms, 2s, 200MB or 1GiB, got '1h'
    """
    if (speed is None) == (budget is None):
        raise ValueError(f"speed, budget: expected one of them, got {speed!r} and {budget!r}")
    found = choices(scale, size)
    if speed is not None:
        if speed not in SPEEDS:
            raise ValueError(f"speed: expected one of {', '.join(SPEEDS)}, got {speed!r}")
        near = [choice for choice in found if choice.below <= SPEEDS[speed]]
        return max((choice for choice in near if choice.ms <= _AS_FAST * near[0].ms), key=lambda choice: choice.psnr)
    read = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([a-zA-Z]+)\s*", budget)
    if read is None or read[2] not in _UNITS:
        raise ValueError(f"budget: expected a time or memory, such as 40ms, 2s, 200MB or 1GiB, got {budget!r}")
    what, unit = _UNITS[read[2]]
    limit = float(read[1]) * unit
    if what == "ms":
        here = pace(scale)
        where = f"on this machine, which takes {here:.2g} times as long as that of the table"
        found = [replace(choice, ms=here * choice.ms, where=where) for choice in found]
    fitting = [choice for choice in found if getattr(choice, what) <= limit]
    if not fitting:
        least = min(found, key=lambda choice: getattr(choice, what))
        raise ValueError(f"budget: nothing fits {budget} for {size[0]} x {size[1]} sensor pixels; least takes {least}")
    return max(fitting, key=lambda choice: choice.psnr)
