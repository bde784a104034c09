"""The operators at the extremes of physics and floating point: ``spikekit extremes`` prints the table.

Every row is an operator at an extreme in one dtype on one device: the worst error against a brute-force reference
(:mod:`spikekit.extremes.reference`), the bound that is asserted and where it comes from, and whether values and
gradients are finite, or which other outcome is the documented one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from itertools import groupby

import torch

from spikekit.extremes import autograd, light, sizes, spikes, warp
from spikekit.extremes.table import BITS, FLOATS, Case, Row, short
from spikekit.io.whole_file import whole_file
from spikekit.tables import table

__all__ = ["CASES", "Case", "Row", "add_arguments", "devices", "rows", "run", "tables"]

CASES: list[Case] = [*light.CASES, *spikes.CASES, *warp.CASES, *sizes.CASES, *autograd.CASES]
_DTYPES = [short(dtype) for dtype in (*FLOATS, *BITS)]


def devices() -> list[str]:
    """Return ``"cpu"``, and ``"cuda"`` where there is one."""
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def operator_names() -> list[str]:
    """Return the names of the operators in the table, in its order."""
    return list(dict.fromkeys(case.operator for case in CASES))


def rows(on: Iterable[str] | None = None, operator: str | None = None) -> Iterator[Row]:
    """Yield the rows as they are measured, one device and one operator after the other.

    Args:
        on: the devices; all there are when not given.
        operator: only this one.
    """
    for device in devices() if on is None else on:
        for name in operator_names() if operator is None else [operator]:
            for case in CASES:
                if case.operator == name:
                    yield from (case.row(dtype, device) for dtype in case.dtypes)


def tables(rows: Iterable[Row], *, markdown: bool = False) -> Iterator[str]:
    """Yield a title and a table for each operator and device as soon as they are there: a line for each extreme.

    Args:
        rows: as :func:`rows` yields them.
        markdown: as Markdown, otherwise as plain text.
    """
    for (operator, device), of_operator in groupby(rows, key=lambda row: (row.operator, row.device)):
        used = {short(dtype) for case in CASES if case.operator == operator for dtype in case.dtypes}
        dtypes = [dtype for dtype in _DTYPES if dtype in used]
        lines = []
        for extreme, group in groupby(of_operator, key=lambda row: row.extreme):
            line = list(group)
            errors = {row.dtype: f"{row.error:.2g}{'' if row.passed else ' FAILS'}" for row in line}
            values, gradients = ({getattr(row, name) for row in line} for name in ("values", "gradients"))
            outcomes = ["/".join(sorted(values)), "/".join(sorted(gradients - {"-"})) or "-"]  # bits have no gradient
            lines.append([extreme, *map(errors.get, dtypes), *outcomes, line[0].bound])
        title = f"\n## {operator} on {device}\n" if markdown else f"\n{operator} on {device}"
        heading = ["extreme", *dtypes, "values", "gradients", "largest error allowed"]
        yield f"{title}\n{table(heading, lines, markdown=markdown)}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``spikekit extremes``."""
    parser.add_argument("--operator", choices=operator_names(), metavar="NAME", help="only the rows of this one")
    parser.add_argument("--device", choices=devices(), help="only on this one; on all there are if not given")
    parser.add_argument("--markdown", action="store_true", help="as Markdown")
    parser.add_argument("-o", "--output", metavar="FILE", help="where to write the table; printed if not given")


def run(args: argparse.Namespace) -> None:
    """Print the table of extremes; the exit status is 1 where an error is larger than its bound."""
    measured: list[Row] = []

    def noted() -> Iterator[Row]:
        for row in rows([args.device] if args.device else None, args.operator):
            measured.append(row)
            yield row

    try:
        with whole_file(args.output, "w", encoding="utf-8") if args.output else nullcontext(sys.stdout) as file:
            for text in tables(noted(), markdown=args.markdown):
                print(text, file=file, flush=True)
    except OSError as error:
        error.filename = args.output  # a full disk does not say which file it has no room for
        raise
    failing = [row for row in measured if not row.passed]
    for row in failing:
        print(_why(row), file=sys.stderr)  # noqa: T201
    if failing:
        raise ValueError(f"{len(failing)} of {len(measured)} rows fail")
    print(f"{len(measured)} rows, none fails", file=sys.stderr)  # noqa: T201


def _why(row: Row) -> str:
    what = row.trouble or f"{row.error:.3g} > {row.limit:.3g}, or values {row.values}, gradients {row.gradients}"
    return f"{row.operator}, {row.extreme}, {row.dtype} on {row.device}: {what}"
