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
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from spikekit.arguments import UsageError, whole
from spikekit.bench import pictures, streams
from spikekit.bench.case import SEED, SIZES, Case, Other, Setup, sizes
from spikekit.examples import EXAMPLES, Example
from spikekit.io.failures import writing
from spikekit.io.whole_file import whole_file
from spikekit.progress import progress
from spikekit.tables import table
from spikekit.timing import Ratio, Run, Timer, floor_run, interleave, peak_memory, ratio, timer_of


def _example(example: Example, setup: Setup) -> Iterator[Case]:
    """The operator beside nothing, where it has no cases of its own."""
    frames, size = 8, (setup.size.height, setup.size.width)
    tensors = tuple(tensor.float().to(setup.device) for tensor in example.tensors((frames,), size))
    height, width = example.results(*tensors)[0].shape[-2:]
    yield Case(f"float32 {', '.join(map(sizes, tensors))}", example.call, tensors, pixels=frames * height * width)


#: The cases of every operator.
CASES = {
    **{example.name: partial(_example, example) for example in EXAMPLES},
    **streams.CASES,
    **pictures.CASES,
}

#: Seconds of one case after which no further round is begun.
CASE_SECONDS = 1.5

# The columns that rows of one case have in common.
_OURS = ("operator", "case", "rounds", "Mpixel/s", "ours / floor", "MiB ours")

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
    add = parser.add_argument
    add("operators", nargs="*", metavar="OPERATOR", help=f"what to measure, all if not given: {', '.join(CASES)}")
    add("--size", choices=SIZES, default="full", help="small shows that everything runs; default full")
    add("--rounds", type=whole(1), default=7, metavar="N", help="timings of each, in turn; default 7")
    add("--threads", type=whole(1), default=1, metavar="N", help="threads of torch; 1 counts CPU time, more wall time")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="default cpu")
    add("--markdown", action="store_true", help="a Markdown table")
    add("-o", "--output", type=Path, metavar="FILE", help="write there what is otherwise printed")


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
    with ExitStack() as stack:
        stack.callback(torch.set_num_threads, torch.get_num_threads())
        torch.set_num_threads(args.threads)
        operators = progress(args.operators or list(CASES), "operators")
        measured = list(rows(operators, args.size, device, args.rounds, timer))
        header = _header(device, unit, args.size)
    text = "\n\n".join(
        [_fenced(header, args.markdown), _table(measured, args.markdown), _fenced(_LEGEND, args.markdown)]
    )
    if args.output is None:
        sys.stdout.write(f"{text}\n")
        return
    with writing(args.output), whole_file(args.output, "w", encoding="utf-8") as file:
        file.write(f"{text}\n")


def rows(operators: Sequence[str], size: str, device: torch.device, rounds: int, timer: Timer) -> Iterator[Row]:
    """Measure all cases of some operators."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        # what is there already is much, and would be searched every time
        gc.collect()
        gc.freeze()
        stack.callback(gc.unfreeze)
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
    pixels, read, written = case.work(result)
    runs: dict[str, Run] = {"": case.run}
    found: dict[str, dict[str, Any]] = {}
    for other in case.others:
        try:
            run = other.prepare(*case.inputs)
            found[other.name] = {"equal": _equal(other, result, run()), "note": other.note}
            runs[other.name] = run
        except Exception as error:
            found[other.name] = {"note": _reason(error)}
    del result
    gc.collect()
    times = interleave({**runs, "floor": floor_run(read, written, device)}, rounds, timer, CASE_SECONDS)
    memory = {name: peak_memory(run, device) for name, run in runs.items()}

    row = Row(
        operator,
        case.name,
        rounds=len(times[""]),
        speed=pixels / max(statistics.median(times[""]), 1e-9) / 1e6,
        floor=ratio(times[""], times["floor"]).median,
        memory=(memory[""], None),
    )
    if not found:
        yield row
    for name, how in found.items():
        if name in runs:
            how |= {"ratio": ratio(times[name], times[""]), "memory": (memory[""], memory[name])}
        yield replace(row, other=name, **how)


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
            cells |= dict.fromkeys(_OURS, "")
        lines.append(list(cells.values()))
        case = row.operator, row.case
    return table(list(_cells(Row("", ""))), lines, markdown=markdown)


def _cells(row: Row) -> dict[str, str]:
    """Return what a row shows, by column."""

    def number(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    return {
        "operator": row.operator,
        "case": row.case,
        "beside": row.other,
        "other / ours": "{:.3g} ({:.3g} .. {:.3g})".format(*row.ratio) if row.ratio else "",
        "rounds": str(row.rounds or ""),
        "Mpixel/s": number(row.speed, ".4g"),
        "ours / floor": number(row.floor, ".3g"),
        "MiB ours": number(row.memory[0], ".1f"),
        "MiB other": number(row.memory[1], ".1f"),
        "equal": "; ".join(filter(None, ["" if row.equal is None else f"{100 * row.equal:.4g} %", row.note])),
    }
