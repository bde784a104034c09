import argparse
import sys
import time
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import pytest
import torch

from spikekit import bench
from spikekit import timing as measure
from spikekit.bench.case import Case, Other
from spikekit.cli.command import main

CPU = torch.device("cpu")
PEERS = {"spikezoo", "spikingjelly", "snntorch"}


def arguments(*argv):
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    return parser.parse_args(argv)


class Clock:
    """Stands still but for the runs that move it on."""

    def __init__(self):
        self.seconds = 0.0
        self.calls = []

    def __call__(self):
        return self.seconds

    def run(self, name, *took):
        took = list(took)

        def run():
            self.calls.append(name)
            self.seconds += took.pop(0) if len(took) > 1 else took[0]

        return run


@pytest.fixture(scope="module")
def without_peers():
    """All cases at the small size, on a machine that has none of the peers."""
    with pytest.MonkeyPatch.context() as patch:
        for name in list(sys.modules):
            if name.split(".")[0] in PEERS:
                patch.delitem(sys.modules, name)
        for name in PEERS:
            patch.setitem(sys.modules, name, None)
        return list(bench.rows(list(bench.CASES), "small", CPU, 1, measure.cpu_timer(time.process_time)))


def test_runs_are_timed_in_turn_after_a_warm_up():
    clock = Clock()
    runs = {"a": clock.run("a", 9.0, 1.0, 2.0), "b": clock.run("b", 9.0, 5.0)}
    times = measure.interleave(runs, 3, measure.cpu_timer(clock))
    assert "".join(clock.calls) == "ab" + "ab" * 3
    assert times == {"a": [1.0, 2.0, 2.0], "b": [5.0, 5.0, 5.0]}


def test_what_is_fast_is_called_several_times_a_timing():
    clock = Clock()
    times = measure.interleave({"a": clock.run("a", 0.5e-3), "b": clock.run("b", 1.0)}, 2, measure.cpu_timer(clock))
    assert "".join(clock.calls) == "ab" + "aaaab" * 2
    assert times["a"] == pytest.approx([0.5e-3] * 2)


def test_no_further_round_once_the_time_is_spent():
    clock = Clock()
    runs = {"a": clock.run("a", 2.0), "b": clock.run("b", 1.0)}
    assert len(measure.interleave(runs, 9, measure.cpu_timer(clock), seconds=11.0)["a"]) == 4
    assert len(measure.interleave(runs, 9, measure.cpu_timer(clock), seconds=1.0)["a"]) == 3
    assert len(measure.interleave(runs, 2, measure.cpu_timer(clock), seconds=1.0)["a"]) == 2
    fast = {"a": clock.run("a", 0.75e-3)}  # three times a timing
    assert len(measure.interleave(fast, 9, measure.cpu_timer(clock), seconds=10e-3)["a"]) == 5


def test_ratio_is_the_median_of_the_rounds():
    # the machine was three times as slow in the second round: the ratio of the medians would be 4
    assert measure.ratio([2.0, 12.0, 4.0], [1.0, 3.0, 1.0]) == measure.Ratio(4.0, 2.0, 4.0)
    assert measure.ratio([2.0, 3.0, 90.0], [1.0, 1.0, 30.0]) == measure.Ratio(3.0, 2.0, 3.0)


def test_floor_reads_and_writes_as_many_bytes_as_it_is_told():
    total, written = measure.floor_run(4000, 800, CPU)()
    assert total == 1000
    assert written.nbytes == 800


def test_peak_memory_sees_what_is_freed_and_what_is_returned():
    def passing():
        np.ones(16 << 20, np.uint8)
        return torch.ones(4 << 20, dtype=torch.uint8)

    np.ones(256 << 20, np.uint8)  # an earlier peak, higher than the one to measure
    mib = measure.peak_memory(passing, CPU)
    if mib is None:
        pytest.skip("no high-water mark on this system")
    assert 15 <= mib <= 24
    assert measure.peak_memory(lambda: torch.ones(64 << 20, dtype=torch.uint8), CPU) >= 63


def case(*others, clock=None, seconds=1.0):
    clock = clock or Clock()

    def ours():
        clock.seconds += seconds
        return torch.arange(4)

    return Case("what it does", ours, (), others, pixels=8_000_000, read=4, written=4), clock


def measured(*others, **options):
    what, clock = case(*others, **options)
    return list(bench.compare(what, "op", CPU, 3, measure.cpu_timer(clock)))


def test_a_row_for_each_other():
    clock = Clock()

    def theirs():
        clock.seconds += 2.5
        return torch.tensor([0, 1, 2, 9])

    (row,) = measured(Other("theirs", lambda: theirs), clock=clock)
    assert (row.operator, row.case, row.other, row.rounds) == ("op", "what it does", "theirs", 3)
    assert row.ratio == measure.Ratio(2.5, 2.5, 2.5)
    assert row.speed == 8
    assert row.equal == 0.75


def test_alone_it_still_gets_a_row():
    (row,) = measured()
    assert (row.other, row.ratio, row.speed) == ("", None, 8)


def test_what_cannot_be_run_says_why_and_the_rest_goes_on():
    def absent():
        import no_such_peer

        return no_such_peer.run

    def breaks():
        raise RuntimeError("of no\nuse")

    rows = measured(
        Other("absent", absent),
        Other("breaks", lambda: breaks),
        Other("other shape", lambda: lambda: torch.arange(5)),
        Other("works", lambda: lambda: torch.arange(4)),
        Other("differs", lambda: lambda: torch.zeros(9), pair=None, note="another operation"),
    )
    assert [row.note for row in rows] == [
        "not installed (no_such_peer)",
        "fails: RuntimeError: of no use",
        "fails: ValueError: gives (5,), not (4,)",
        "",
        "another operation",
    ]
    assert [row.equal for row in rows] == [None, None, None, 1.0, None]
    assert [row.ratio is None for row in rows] == [True, True, True, False, False]


def test_an_operator_that_fails_leaves_the_others_their_rows(monkeypatch):
    def failing(setup):
        yield case()[0]
        raise RuntimeError("out of memory")

    monkeypatch.setattr(bench, "CASES", {"bad": failing, "good": lambda setup: iter([case()[0]])})
    found = list(bench.rows(["bad", "good"], "small", CPU, 1, measure.cpu_timer(Clock())))
    assert [(row.operator, row.note) for row in found] == [
        ("bad", ""),
        ("bad", "fails: RuntimeError: out of memory"),
        ("good", ""),
    ]


def test_every_operator_has_rows_and_nothing_fails(without_peers):
    assert {row.operator for row in without_peers} == set(bench.CASES)
    assert [row for row in without_peers if row.note.startswith("fails")] == []
    assert all(0 < row.ratio.least <= row.ratio.median <= row.ratio.most for row in without_peers if row.ratio)
    assert all(row.floor > 0 and row.speed > 0 for row in without_peers if row.ratio)


def test_results_equal_those_of_plain_code(without_peers):
    differ = {(row.case, row.other): row.equal for row in without_peers if row.equal not in (None, 1.0)}
    assert all(other == "without steps" and equal > 0.95 for (_, other), equal in differ.items()), differ
    assert sum(row.equal == 1.0 for row in without_peers) >= 20


def test_missing_peers_are_named(without_peers):
    missing = {row.note for row in without_peers if row.ratio is None and row.other}
    assert all(note.startswith("not installed") for note in missing)
    assert {name for name in PEERS if any(name in note for note in missing)} == PEERS


def test_says_whether_numba_is_there(monkeypatch):
    def missing(name):
        raise PackageNotFoundError(name)

    pytest.importorskip("numba", reason="Numba is not installed")
    assert f"Numba {version('numba')}, Python" in bench.software()
    monkeypatch.setattr(bench, "version", missing)
    assert "no Numba, Python" in bench.software()


@pytest.mark.parametrize("markdown", [False, True])
def test_prints_a_table(capsys, markdown):
    bench.run(arguments("mosaic", "demosaic", "--size", "small", "--rounds", "2", *["--markdown"] * markdown))
    text = capsys.readouterr().out
    assert f"torch    {torch.__version__}" in text
    assert "1 threads used" in text
    assert "process CPU time" in text
    lines = [line for line in text.splitlines() if "kornia r" in line]
    assert len(lines) == 2
    if markdown:
        columns = [cell.strip() for cell in lines[0].strip("|").split("|")]
        assert columns[0] == "mosaic"
        assert columns[2] == "kornia rgb_to_raw"
        assert 0 < float(columns[3].split()[0]) < 1e6
        assert float(columns[5]) > 0
        assert float(columns[6]) > 0
        assert columns[9] == "100 %"


def test_names_what_is_missing(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "spikezoo", None)
    bench.run(arguments("write_spikes", "--size", "small", "--rounds", "1"))
    assert "not installed (spikezoo" in capsys.readouterr().out


def test_writes_a_file(tmp_path, capsys):
    bench.run(arguments("ssim", "--size", "small", "--rounds", "1", "-o", str(tmp_path / "bench.txt")))
    assert capsys.readouterr().out == ""
    assert "scikit-image" in (tmp_path / "bench.txt").read_text()
    with pytest.raises(ValueError, match="cannot be written"):
        bench.run(arguments("ssim", "--size", "small", "--rounds", "1", "-o", str(tmp_path)))


def test_more_threads_are_timed_by_the_wall(capsys):
    before = torch.get_num_threads()
    bench.run(arguments("mosaic", "--size", "small", "--rounds", "1", "--threads", str(before + 1)))
    text = capsys.readouterr().out
    assert f"{before + 1} threads used" in text
    assert "wall time" in text
    assert torch.get_num_threads() == before


def test_refuses_an_operator_that_is_not_measured(capsys):
    with pytest.raises(ValueError, match=r"operators: expected some of .*tfi.*, got warp"):
        bench.run(arguments("tfi", "warp"))
    assert main(["bench", "foo"]) == 2
    assert capsys.readouterr().err.endswith(", got foo\n")


@pytest.mark.parametrize(("processor", "said"), [("", "riscv64"), ("a chip", "a chip")])
def test_a_processor_that_linux_does_not_tell_of(monkeypatch, processor, said):
    monkeypatch.setattr(bench, "Path", lambda path: path)  # no text to read
    monkeypatch.setattr(bench.platform, "processor", lambda: processor)
    monkeypatch.setattr(bench.platform, "machine", lambda: "riscv64")
    assert bench.cpu_name() == said


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_refuses_a_device_that_is_not_there():
    with pytest.raises(ValueError, match="--device: cuda cannot be used here"):
        bench.run(arguments("--device", "cuda"))


@pytest.mark.parametrize("argv", [["--rounds", "0"], ["--threads", "two"], ["--size", "huge"], ["--device", "abacus"]])
def test_refuses_options(argv):
    with pytest.raises(SystemExit):
        arguments(*argv)
