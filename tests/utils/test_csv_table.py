"""Tables of numbers are read from CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjlab.utils.csv_table import CsvTable
from mjlab.utils.errors import UserError


def test_columns_by_name(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    # As spreadsheets write it: with a byte order mark and spaces.
    path.write_text("\ufefftime, q.a ,q.b\n0,1,2\n0.1, ,4\n", encoding="utf-8")
    table = CsvTable(path)
    assert list(table.columns) == ["time", "q.a", "q.b"]
    group = table.group("q", ["b", "a"])
    assert group is not None
    assert group[0].tolist() == [2.0, 1.0]
    assert np.isnan(group[1, 1])
    assert table.empty["q.a"].tolist() == [False, True]
    path.write_text("a\nnan\n")
    assert not CsvTable(path).empty["a"][0]
    assert table.group("q", ["a", "c"]) is None


@pytest.mark.parametrize(
    "text", ["", "a,b\n", "a,b\n1\n", "a,b\n1,2,3\n", "a,b\n1,2\n3\n", "a\nx\n"]
)
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(UserError, match=r"table\.csv: expected"):
        CsvTable(tmp_path / "table.csv")
