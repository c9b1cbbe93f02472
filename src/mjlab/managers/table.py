"""Plain text tables: what printing a manager shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def format_table(title: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a text table with a numbered row for each of `rows`.

    Args:
        title: One line above the table.
        header: Names of the columns; a column of row numbers is put before them.
        rows: As many cells a row as there are columns; cells are shown by `str`.
    """
    cells = [["#", *header]]
    cells += [[str(i), *(str(cell) for cell in row)] for i, row in enumerate(rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(cells[0]))]
    rule = "+" + "+".join("-" * (width + 2) for width in widths) + "+"
    lines = [
        "|" + "|".join(f" {cell:<{width}} " for cell, width in zip(row, widths, strict=True)) + "|"
        for row in cells
    ]
    return "\n".join([title, rule, lines[0], rule, *lines[1:], rule])
