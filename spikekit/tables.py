"""Tables as the commands print and write them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tabulate import tabulate


def table(heading: Sequence[str], rows: Iterable[Sequence[object]], *, markdown: bool = True) -> str:
    """Return a table whose columns are aligned.

    Args:
        heading: of the columns.
        rows: the cells of each; None is an empty one.
        markdown: as Markdown, with a rule under the heading; otherwise as plain text.

    Returns:
        Lines without a newline at the end.

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
