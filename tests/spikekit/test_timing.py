import sys

import numpy as np
import pytest
import torch

from spikekit.timing import Ratio, cpu_timer, interleave, peak_memory, ratio


class Clock:
    """Stands still but for the runs that move it on."""

    def __init__(self):
        self.seconds, self.calls = 0.0, ""

    def __call__(self):
        return self.seconds

    def run(self, name, *took):
        took = list(took)

        def run():
            self.calls += name
            self.seconds += took.pop(0) if len(took) > 1 else took[0]

        return run


def test_runs_are_timed_in_turn_after_a_warm_up():
    clock = Clock()
    times = interleave({"a": clock.run("a", 9.0, 1.0, 2.0), "b": clock.run("b", 9.0, 5.0)}, 3, cpu_timer(clock))
    assert clock.calls == "ab" + "ab" * 3
    assert times == {"a": [1.0, 2.0, 2.0], "b": [5.0, 5.0, 5.0]}


def test_what_is_fast_is_called_several_times_a_timing():
    clock = Clock()
    times = interleave({"a": clock.run("a", 0.5e-3), "b": clock.run("b", 1.0)}, 2, cpu_timer(clock))
    assert clock.calls == "ab" + "aaaab" * 2
    assert times["a"] == pytest.approx([0.5e-3] * 2)


@pytest.mark.parametrize(("seconds", "rounds"), [(11.0, 4), (1.0, 3)])
def test_no_further_round_once_the_time_is_spent(seconds, rounds):
    clock = Clock()
    runs = {"a": clock.run("a", 2.0), "b": clock.run("b", 1.0)}
    assert len(interleave(runs, 9, cpu_timer(clock), seconds=seconds)["a"]) == rounds


def test_a_ratio_compares_the_timings_of_one_round():
    # the machine was three times as slow in the second round: the ratio of the medians would be 4
    assert ratio([2.0, 3.0, 90.0], [1.0, 1.0, 30.0]) == Ratio(3.0, 2.0, 3.0)


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
def test_peak_memory_sees_what_is_freed_and_what_is_returned():
    def passing():
        np.ones(16 << 20, np.uint8)
        return torch.ones(4 << 20, dtype=torch.uint8)

    np.ones(256 << 20, np.uint8)  # an earlier peak, higher than the one to measure
    device = torch.device("cpu")
    assert 15 <= peak_memory(passing, device) <= 24
    assert peak_memory(lambda: torch.ones(64 << 20, dtype=torch.uint8), device) >= 63
