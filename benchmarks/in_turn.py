"""Timing of several functions in turn, in one process; imported by the other scripts of this folder."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from spikekit.timing import Run, Timer

_SHORTEST = 2e-3  # seconds; faster functions are called several times per timing
_FEWEST_ROUNDS = 3


def interleave(runs: Mapping[str, Run], rounds: int, timer: Timer, seconds: float = math.inf) -> dict[str, list[float]]:
    """Time all runs in turn, A B C A B C ..., so that other load on the machine affects all of them equally.

    Every run is called once before, to warm up and to find the number of calls that take a few milliseconds.

    Args:
        runs: functions to time, by name.
        rounds: number of timings of each.
        timer: timer of the device.
        seconds: after this time no further round is started; at least three are.

    Returns:
        Seconds per call, by name, one value per round.
    """
    number = {}
    for name, run in runs.items():
        number[name] = min(100, math.ceil(_SHORTEST / max(timer(run, 1), 1e-9)))
    times: dict[str, list[float]] = {name: [] for name in runs}
    spent = 0.0
    for done in range(rounds):
        if done >= _FEWEST_ROUNDS and spent > seconds:
            break
        for name, run in runs.items():
            took = timer(run, number[name])
            times[name].append(took)
            spent += took * number[name]
    return times


class Ratio(NamedTuple):
    """Ratio of the times of two runs: median, minimum and maximum over the rounds."""

    median: float
    least: float
    most: float


def ratio(times: Sequence[float], reference: Sequence[float]) -> Ratio:
    """Return the ratio of two runs, compared round by round.

    Example:
        >>> ratio([2.0, 30.0, 4.0], [1.0, 10.0, 1.0])
        Ratio(median=3.0, least=2.0, most=4.0)
    """
    ratios = [a / max(b, 1e-9) for a, b in zip(times, reference, strict=True)]
    return Ratio(statistics.median(ratios), min(ratios), max(ratios))
