"""Tables of numbers in CSV files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from mjlab.utils.errors import UserError


class CsvTable:
    """Columns of a CSV file.

    Attributes:
        path: File.
        columns: Values by name, (K,). NaN: empty, or written so.
        empty: Cells without text by name, (K,).
    """

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            UserError: the file cannot be read as a table of numbers.
        """
        self.path = path
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                header, *rows = csv.reader(file)
            cells = [[cell.strip() for cell in row] for row in rows]
            values = np.array([[float(cell or "nan") for cell in row] for row in cells])
            if not len(values):
                raise UserError(f"{path}: expected rows below the header, got none.")
            names = [name.strip() for name in header]
            self.columns: dict[str, np.ndarray] = dict(zip(names, values.T, strict=True))
            empty = np.array([[not cell for cell in row] for row in cells])
            self.empty: dict[str, np.ndarray] = dict(zip(names, empty.T, strict=True))
        except (OSError, ValueError) as error:
            raise UserError(f"{path}: expected a CSV table of numbers ({error}).") from error

    def group(self, name: str, labels: list[str]) -> np.ndarray | None:
        """Return the columns `name.<label>`, (K, n); None if one is missing."""
        keys = [f"{name}.{label}" for label in labels]
        if not keys or any(key not in self.columns for key in keys):
            return None
        return np.stack([self.columns[key] for key in keys], axis=1)
