"""``--table FILE`` writes what the rows measured: a line for every extreme of an operator."""

import csv
from itertools import groupby

import pytest

from extremes.table import BITS, FLOATS, short

ROWS = pytest.StashKey[list]()


@pytest.fixture
def note(request):
    return request.config.stash.setdefault(ROWS, []).append


def lines(rows):
    """Errors by dtype, the outcomes and the bound of every extreme."""
    dtypes = [short(dtype) for dtype in (*FLOATS, *BITS)]
    yield ["operator", "extreme", *dtypes, "values", "gradients", "largest error allowed", "device"]
    for (operator, extreme, device), group in groupby(rows, key=lambda row: (row.operator, row.extreme, row.device)):
        line = list(group)
        errors = {row.dtype: f"{row.error:.2g}{'' if row.passed else ' FAILS'}" for row in line}
        values, gradients = ({getattr(row, name) for row in line} for name in ("values", "gradients"))
        outcomes = ["/".join(sorted(values)), "/".join(sorted(gradients - {"-"})) or "-"]  # bits have no gradient
        yield [operator, extreme, *map(errors.get, dtypes), *outcomes, line[0].bound, device]


def pytest_sessionfinish(session):
    path, rows = session.config.getoption("table"), session.config.stash.get(ROWS, [])
    if path and rows:
        with open(path, "w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(lines(rows))
