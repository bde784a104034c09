"""The benchmark: every operator beside its usual alternative, in one process, in turns.

Ratios hold on any machine that is not too different; absolute figures hold on the one that printed them.
"""

from __future__ import annotations

import argparse
import gc
import os
import platform
import re
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from spikekit.arguments import UsageError
from spikekit.bench import pictures, streams
from spikekit.bench.case import SEED, SIZES, Case, Other, Setup, sizes
from spikekit.examples import EXAMPLES, Example
from spikekit.io.whole_file import whole_file
from spikekit.tables import table
from spikekit.timing import Ratio, Run, Timer, floor_run, interleave, peak_memory, ratio, timer_of


def _example(example: Example, setup: Setup) -> Iterator[Case]:
    """The operator beside nothing, where it has no cases of its own."""
    frames, size = 8, (setup.size.height, setup.size.width)
    tensors = [tensor.float().to(setup.device) for tensor in example.tensors((frames,), size)]
    results = example.results(*tensors)
    read, written = (sum(tensor.nbytes for tensor in some) for some in (tensors, results))
    pixels = frames * results[0].shape[-2] * results[0].shape[-1]
    yield Case(f"float32 {', '.join(map(sizes, tensors))}", partial(example.call, *tensors), pixels, read, written)


#: The cases of every operator.
CASES = {
    **{example.name: partial(_example, example) for example in EXAMPLES},
    **streams.CASES,
    **pictures.CASES,
}

#: Seconds of one case after which no further round is begun.
CASE_SECONDS = 1.5

COLUMNS = [
    "operator", "case", "beside", "other / ours", "rounds", "Mpixel/s", "ours / floor", "MiB ours", "MiB other", "equal"
]  # fmt: skip
_OURS = {"operator", "case", "rounds", "Mpixel/s", "ours / floor", "MiB ours"}

_LEGEND = """\
other / ours  time of what stands under "beside" over that of spikekit: median of the rounds (least .. most)
Mpixel/s      million pixels of a frame that spikekit makes a second (all channels of a pixel count as one)
ours / floor  time of spikekit over that of a kernel that only reads the input once and writes the result once, in
              memory that is already there
MiB           by how much a call raises the memory in use, its result included
equal         share of the values that are equal, where the two should be"""


@dataclass(frozen=True)
class Row:
    """One line of the table: our code beside one other, or alone where ``other`` is empty.

    Attributes:
        operator: its public name.
        case: what goes in and what comes out.
        other: what it is measured beside, empty where there is nothing.
        ratio: time of the other over ours; None where the other could not be run.
        rounds: how many timings the ratio is the median of.
        speed: million pixels a second, ours.
        floor: our time over that of the memory-bandwidth floor.
        memory: peak MiB above the inputs, ours and the other's.
        equal: share of the compared values that are equal; None where nothing should be.
        note: how the other differs, or why it was not run.
    """

    operator: str
    case: str
    other: str = ""
    ratio: Ratio | None = None
    rounds: int = 0
    speed: float | None = None
    floor: float | None = None
    memory: tuple[float | None, float | None] = (None, None)
    equal: float | None = None
    note: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark to a parser."""
    parser.add_argument(
        "operators", nargs="*", metavar="OPERATOR", help=f"what to measure, all if not given: {', '.join(CASES)}"
    )
    parser.add_argument("--size", choices=SIZES, default="full", help="small shows that everything runs; default full")
    parser.add_argument("--rounds", type=_rounds, default=7, metavar="N", help="timings of each, in turn; default 7")
    parser.add_argument(
        "--threads", type=_rounds, default=1, metavar="N", help="threads of torch; 1 counts CPU time, more wall time"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="default cpu")
    parser.add_argument("--markdown", action="store_true", help="a Markdown table")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write there what is otherwise printed")


def run(args: argparse.Namespace) -> None:
    """Measure every operator beside its usual alternative, and print the table."""
    unknown = [name for name in args.operators if name not in CASES]
    if unknown:
        raise UsageError(f"operators: expected some of {', '.join(CASES)}, got {', '.join(unknown)}")
    try:
        device = torch.empty(0, device=args.device).device
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"--device: {args.device} cannot be used here ({str(error).splitlines()[0]})") from error
    timer, unit = timer_of(device, args.threads)
    with _threads(args.threads):
        measured = list(rows(args.operators or list(CASES), args.size, device, args.rounds, timer))
        header = _header(device, unit, args.size)
    text = "\n\n".join(
        [_fenced(header, args.markdown), _table(measured, args.markdown), _fenced(_LEGEND, args.markdown)]
    )
    if args.output is None:
        sys.stdout.write(f"{text}\n")
        return
    try:
        with whole_file(args.output, "w", encoding="utf-8") as file:
            file.write(f"{text}\n")
    except OSError as error:
        raise ValueError(f"{args.output}: cannot be written ({error.strerror or error})") from error


def rows(operators: Sequence[str], size: str, device: torch.device, rounds: int, timer: Timer) -> Iterator[Row]:
    """Measure all cases of some operators."""
    with tempfile.TemporaryDirectory() as folder, _frozen():
        setup = Setup(SIZES[size], device, Path(folder))
        for operator in operators:
            try:
                for case in CASES[operator](setup):
                    yield from compare(case, operator, device, rounds, timer)
            except Exception as error:  # the other operators are worth their lines
                yield Row(operator, "", note=_reason(error))


def compare(case: Case, operator: str, device: torch.device, rounds: int, timer: Timer) -> Iterator[Row]:
    """Measure one case beside everything that can be run; what cannot gets a row that says why."""
    result = case.run()
    runs: dict[str, Run] = {}
    equal: dict[str, float | None] = {}
    failed: dict[str, str] = {}
    for other in case.others:
        try:
            run = other.prepare()
            equal[other.name] = _equal(other, result, run())
            runs[other.name] = run
        except Exception as error:
            failed[other.name] = _reason(error)
    del result
    gc.collect()
    floor = floor_run(case.read, case.written, device)
    times = interleave({"": case.run, **runs, "floor": floor}, rounds, timer, CASE_SECONDS)
    memory = {name: peak_memory(run, device) for name, run in {"": case.run, **runs}.items()}

    row = Row(
        operator,
        case.name,
        rounds=len(times[""]),
        speed=case.pixels / max(statistics.median(times[""]), 1e-9) / 1e6,
        floor=ratio(times[""], times["floor"]).median,
        memory=(memory[""], None),
    )
    if not case.others:
        yield row
    for other in case.others:
        if other.name in failed:
            yield replace(row, other=other.name, note=failed[other.name])
        else:
            yield replace(
                row,
                other=other.name,
                ratio=ratio(times[other.name], times[""]),
                memory=(memory[""], memory[other.name]),
                equal=equal[other.name],
                note=other.note,
            )


def _equal(other: Other, ours: object, theirs: object) -> float | None:
    """Share of the values that are equal."""
    if other.pair is None:
        return None
    a, b = (value.detach().double() for value in other.pair(ours, theirs))
    if a.shape != b.shape:
        raise ValueError(f"gives {tuple(b.shape)}, not {tuple(a.shape)}")
    return torch.isclose(a, b, rtol=other.tolerance, atol=other.tolerance).double().mean().item()


def _reason(error: Exception) -> str:
    if isinstance(error, ImportError):
        return f"not installed ({error.name or error})" if isinstance(error, ModuleNotFoundError) else f"fails: {error}"
    return f"fails: {type(error).__name__}: {' '.join(str(error).split())[:120]}"


def _header(device: torch.device, unit: str, size: str) -> str:
    # what a result costs depends on whether the heap keeps its pages
    heap = [f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("MALLOC_")]
    lines = [
        f"machine  {cpu_name()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads used",
        ", ".join([software(), *heap]),
        f"time     {unit}; size {size}, seed {SEED}",
    ]
    if device.type == "cuda":
        lines.insert(1, f"device   {torch.cuda.get_device_name(device)}")
    return "\n".join(lines)


def cpu_name() -> str:
    """Return what the processor calls itself."""
    with suppress(OSError, AttributeError):
        return re.search(r"^model name\s*:\s*(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)[1]  # type: ignore[index]
    return platform.processor() or platform.machine()


def software() -> str:
    """Return, as a line, what times depend on."""
    try:
        numba = f"Numba {version('numba')}"
    except PackageNotFoundError:
        numba = "no Numba"
    return f"torch    {torch.__version__}, {numba}, Python {platform.python_version()}, {platform.system()}"


def _fenced(text: str, markdown: bool) -> str:
    return f"```text\n{text}\n```" if markdown else text


def _table(rows: Sequence[Row], markdown: bool) -> str:
    lines, case = [], None
    for row in rows:
        cells = _cells(row)
        if case == (row.operator, row.case) and not markdown:  # the line above says what is ours
            cells = ["" if column in _OURS else cell for column, cell in zip(COLUMNS, cells, strict=True)]
        lines.append(cells)
        case = row.operator, row.case
    return table(COLUMNS, lines, markdown=markdown)


def _cells(row: Row) -> list[str]:
    def number(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    return [
        row.operator,
        row.case,
        row.other,
        "" if row.ratio is None else f"{row.ratio.median:.3g} ({row.ratio.least:.3g} .. {row.ratio.most:.3g})",
        str(row.rounds or ""),
        number(row.speed, ".4g"),
        number(row.floor, ".3g"),
        *(number(mib, ".1f") for mib in row.memory),
        "; ".join(filter(None, ["" if row.equal is None else f"{100 * row.equal:.4g} %", row.note])),
    ]


@contextmanager
def _frozen() -> Iterator[None]:
    """Keep what is there already out of the garbage collector's way: it is much, and would be searched every time."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def _threads(number: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _rounds(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number, 1 or more, got {text}")
    return int(text)
