"""Tables for commands and reports."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tabulate import tabulate


def table(heading: Sequence[str], rows: Iterable[Sequence[object]], *, markdown: bool = True) -> str:
    """Format an aligned table as Markdown or plain text; None is an empty cell.

    Example:
        >>> print(table(["decoder", "PSNR (dB)"], [["TFI", "26.10"], ["TFP", None]]))
        | decoder   | PSNR (dB)   |
        |-----------|-------------|
        | TFI       | 26.10       |
        | TFP       |             |
    """
    bar = "\\|" if markdown else "|"

    def text(cell: object) -> str:
        return "" if cell is None else " ".join(str(cell).splitlines()).replace("|", bar)

    cells = [list(map(text, row)) for row in (heading, *rows)]
    return tabulate(cells, "firstrow", tablefmt="github" if markdown else "plain", disable_numparse=True)
