"""Tables of terms, entities and sensors: as text, Markdown, HTML and plain values.

`Table` holds Python values; cells are formatted when the table is shown. A class that derives from
`Tabular` and defines `tables` prints its tables, and shows them as HTML in a notebook.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from numbers import Real
from typing import Any

from mjlab.utils.os import to_plain
from mjlab.utils.string import escaped

WIDTH = 100
"""Width of tables as text (characters)."""

# Columns shown as `name=value` behind the name in another column.
_DETAILS = {"parameters": "function", "settings": "type"}
# Longer cells are wrapped (characters).
_MAX_UNWRAPPED = 24
# Longer lists and mappings are cut after so many characters.
_MAX_ITEMS_LENGTH = 60
# Special characters of Markdown; cells with one of them are set as code.
_SPECIAL = re.compile(r"[*_<>\[\]{}$|\\^~`]")
# Ranges and other short lists stay in one line: their spaces are replaced while text is wrapped.
_SHORT_PARENTHESES = re.compile(r"(?:[^\s(){},]+: )?\([^()]{,30}\)")
_GLUE = "\ue000"
_CELL_STYLE = "text-align: left; vertical-align: top; padding: 2px 12px 2px 0"


@dataclass
class Table:
    """Table with one row per term.

    Text, Markdown and HTML show a function and its parameters, or a type and its settings, in one
    column at the end, and leave out columns without values; a line below names them.
    """

    name: str
    """Name in lower case, such as `rewards`; key of JSON."""
    columns: tuple[str, ...]
    """Column names, the name of the term first."""
    rows: Sequence[Sequence[Any]] = ()
    """Values of each row, one per column. None: unset."""
    note: str = ""
    """Remark in the title."""

    @property
    def title(self) -> str:
        """Name with a capital letter, and the note."""
        return ": ".join(filter(None, (self.name.capitalize(), self.note)))

    def __str__(self) -> str:
        return self.text()

    def records(self) -> list[dict[str, Any]]:
        """Return the rows as dicts of JSON values, by column name, with all columns."""
        return [
            {column: json_value(v) for column, v in zip(self.columns, row, strict=True)}
            for row in self.rows
        ]

    def text(self, width: int = WIDTH) -> str:
        """Return the table as ASCII text of at most `width` characters per line."""
        from rich.box import Box
        from rich.console import Console
        from rich.table import Table as RichTable
        from rich.text import Text

        # A rule below the header, and no other lines.
        box = Box("    \n    \n -- \n    \n    \n    \n    \n    \n", ascii=True)
        table = RichTable(box=box, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
        shown = self._shown()
        for column in shown:
            table.add_column(
                column.name,
                justify="right" if column.is_numeric else "left",
                overflow="fold",
                # Only long cells are wrapped.
                no_wrap=max(map(len, column.cells)) <= _MAX_UNWRAPPED,
            )
        for cells in zip(*(column.cells for column in shown), strict=True):
            table.add_row(*(Text(_SHORT_PARENTHESES.sub(_glue, cell)) for cell in cells))
        file = io.StringIO()
        Console(file=file, width=width, color_system=None, force_jupyter=False).print(table)
        text = file.getvalue().replace(_GLUE, " ")
        return "\n".join([*(line.rstrip() for line in text.splitlines()), *self._unset()])

    def markdown(self) -> str:
        """Return the table in Markdown."""
        shown = self._shown()
        header = [column.name for column in shown]
        rule = ["---:" if column.is_numeric else "---" for column in shown]
        cells = zip(*([_markdown(c) for c in column.cells] for column in shown), strict=True)
        table = "\n".join(f"| {' | '.join(line)} |" for line in (header, rule, *cells))
        return "\n\n".join([table, *self._unset()])

    def html(self) -> str:
        """Return the table in HTML, folded by a click on its title."""

        def row(cells: Iterable[str], tag: str) -> str:
            inner = (f'<{tag} style="{_CELL_STYLE}">{escaped(cell)}</{tag}>' for cell in cells)
            return f"<tr>{''.join(inner)}</tr>"

        shown = self._shown()
        body = [row(cells, "td") for cells in zip(*(c.cells for c in shown), strict=True)]
        return (
            f"<details open><summary><b>{escaped(self.title)}</b></summary><table>"
            f"<thead>{row((c.name for c in shown), 'th')}</thead><tbody>{''.join(body)}</tbody>"
            f"</table>{escaped(''.join(self._unset()))}</details>"
        )

    def _shown(self) -> list[_Column]:
        """Return the columns with values."""
        columns = {
            name: _Column(name, [row[k] for row in self.rows])
            for k, name in enumerate(self.columns)
        }
        for details, owner in _DETAILS.items():
            if details in columns:
                last, added = columns.pop(owner), columns.pop(details)
                pairs = zip(last.cells, added.cells, strict=True)
                last.cells = [": ".join(filter(None, pair)) for pair in pairs]
                columns[owner] = last
        return [column for column in columns.values() if any(column.cells)]

    def _unset(self) -> list[str]:
        """Return the line that names the columns left out."""
        shown = {*_DETAILS, *(column.name for column in self._shown())}
        unset = [column for column in self.columns if column not in shown]
        return [f"Unset: {', '.join(unset)}."] if self.rows and unset else []


class _Column:
    """Cells of a column as text."""

    def __init__(self, name: str, values: list[Any]) -> None:
        self.name = name
        values = [_array_as_list(value) for value in values]
        self.cells = ["" if value is False else format_value(value) for value in values]
        if name in _DETAILS:
            self.cells = [
                ", ".join(f"{key}={format_value(item)}" for key, item in value.items())
                for value in values
            ]
        self.is_numeric = all(
            value is None or isinstance(value, Real) and not isinstance(value, bool)
            for value in values
        )


class Tabular:
    """Base class of objects shown as tables. Subclasses define `tables` and `__repr__`, one line."""

    def tables(self) -> list[Table]:
        """Return the tables to show."""
        raise NotImplementedError

    def __str__(self) -> str:
        """Return all tables as text."""
        return "\n\n".join([repr(self), tables_text(self.tables())]).rstrip()

    def _repr_html_(self) -> str:
        """Return all tables as HTML, shown by notebooks."""
        tables = "".join(table.html() for table in self.tables() if table.rows)
        return f"<div><code>{escaped(repr(self))}</code>{tables}</div>"


def tables_text(tables: Sequence[Table], width: int = WIDTH) -> str:
    """Return tables with rows as text; with titles if there are several."""
    shown = [table for table in tables if table.rows]
    if len(tables) == 1:
        return "".join(table.text(width) for table in shown)
    return "\n\n".join(f"{table.title}\n{table.text(width)}" for table in shown)


# Cells.


def format_value(value: Any) -> str:
    """Return a value in short ASCII: four digits, long lists cut, functions by name."""
    value = _array_as_list(value)
    value = value.value if isinstance(value, enum.Enum) else value
    if value is None or isinstance(value, (str, bool, int)):
        return "" if value is None else _ascii(str(value))
    if isinstance(value, Real):
        return f"{float(value):.4g}"
    if isinstance(value, Mapping):
        return (
            "{" + _join([f"{format_value(k)}: {format_value(v)}" for k, v in value.items()]) + "}"
        )
    if isinstance(value, (list, tuple, set, frozenset)):
        return "(" + _join([format_value(item) for item in value]) + ")"
    if callable(value):
        return function_name(value)
    if dataclasses.is_dataclass(value) and type(value).__str__ is object.__str__:
        settings = settings_of(value)
        return f"{{{', '.join(f'{k}: {format_value(v)}' for k, v in settings.items())}}}"
    return _ascii(str(to_plain(value)) if type(value).__str__ is object.__str__ else str(value))


def json_value(value: Any) -> Any:
    """Return a value as JSON: dicts with string keys, lists, strings, finite numbers, None.

    Configs become dicts of their set fields and `type`, functions "module:name", and numbers that
    are not finite strings.
    """
    value = _array_as_list(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {"type": type(value).__name__, **json_value(settings_of(value))}
    if isinstance(value, Mapping):
        return {str(to_plain(key)): json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    plain = to_plain(value)
    if isinstance(plain, float) and not math.isfinite(plain):
        return str(plain)
    return plain


def settings_of(cfg: Any, *omitted: str, changed_only: bool = False) -> dict[str, Any]:
    """Return the fields of a config that are set, or, with `changed_only`, not at their defaults.

    Unset: None, empty, or by default False or a slice.
    """
    if not dataclasses.is_dataclass(cfg):
        return {}
    settings: dict[str, Any] = {}
    for f in dataclasses.fields(cfg):
        value = getattr(cfg, f.name)
        default = f.default if f.default_factory is MISSING else f.default_factory()
        is_default = to_plain(value) == to_plain(default)
        is_empty = value is None or (isinstance(value, (str, Mapping, list, tuple)) and not value)
        is_unset = is_empty or (is_default and (value is False or isinstance(value, slice)))
        if f.name not in omitted and not is_unset and not (changed_only and is_default):
            settings[f.name] = value
    return settings


def function_name(function: Any) -> str:
    """Return the name of a term's function, or of the class of a class-based term."""
    if isinstance(function, functools.partial):
        function = function.func
    return getattr(function, "__name__", type(function).__name__)


def format_shape(shape: Sequence[int]) -> int | str:
    """Return the size of a vector, or the sizes of several dimensions, such as `3x64x64`."""
    return shape[0] if len(shape) == 1 else "x".join(map(str, shape))


def _array_as_list(value: Any) -> Any:
    """Return tensors and arrays as numbers or lists, rounded to the precision of float32."""
    if not hasattr(value, "tolist") or isinstance(value, type):
        return value

    def rounded(item: Any) -> Any:
        if isinstance(item, list):
            return [rounded(part) for part in item]
        return float(f"{item:.7g}") if isinstance(item, float) else item

    return rounded(value.tolist())


def _join(items: list[str]) -> str:
    length, shown = 0, 0
    for item in items:
        length += len(item) + 2
        shown += length <= _MAX_ITEMS_LENGTH
    shown = max(shown, 1)
    # A last item is never replaced by a longer remark.
    if shown >= len(items) - 1:
        return ", ".join(items)
    return f"{', '.join(items[:shown])}, ... {len(items)} in all"


def _ascii(text: str) -> str:
    return text.encode("ascii", "backslashreplace").decode()


def _markdown(cell: str) -> str:
    """Return a cell as Markdown, as code if it has special characters."""
    cell = " ".join(cell.splitlines())
    if _SPECIAL.search(cell):
        cell = f"`{cell.replace('`', chr(39))}`"
    return cell.replace("|", r"\|")


def _glue(match: re.Match[str]) -> str:
    return match.group().replace(" ", _GLUE)
