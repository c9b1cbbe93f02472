"""Lenient name matching by regular expression, for spec editors and config dictionaries.

Patterns match at the START of a name (`re.match`), so "hip" matches "hip_b". Entity lookups match
whole names: see `mjlab.utils.lab_api.string.resolve_matching_names`.
"""

from __future__ import annotations

import difflib
import html
import logging
import os
import re
import shlex
import subprocess
from collections.abc import Iterable, Sequence
from typing import Any

logger = logging.getLogger(__name__)

# Characters of escaped HTML that may have a meaning within a line of Markdown: all but these few, also `_`
# at the ends of a word, and those that make an address a link.
_MARKUP = re.compile(
    r"[^\w .,:;/()+=%&#-]|(?<![^\W_])_|_(?![^\W_])|:(?=//)|(?<=www)\.", re.IGNORECASE
)

# Maximum number of names listed in full; of longer lists, number of close names per query.
_FEW = 12
_SHOWN = 3


def resolve_expr(
    pattern_map: dict[str, Any], names: tuple[str, ...], default_val: Any = None
) -> tuple[Any, ...]:
    """Return the value of the first pattern (in dict order) that matches each name's start.

    Args:
        pattern_map: Regular expression to value.
        names: Names to resolve.
        default_val: Value of unmatched names.

    Logs a warning for patterns that match no name, because these are usually misspelled. Raises
    `ValueError` for a pattern that is not a valid regular expression.
    """
    _report_unmatched(pattern_map, names)
    return first_matches(pattern_map, names, default_val)


def first_matches(
    pattern_map: dict[str, Any], names: tuple[str, ...], default_val: Any = None
) -> tuple[Any, ...]:
    """Return the values of `resolve_expr`, without warnings."""
    compiled = [(compile_pattern(pattern), value) for pattern, value in pattern_map.items()]
    return tuple(
        next((value for pattern, value in compiled if pattern.match(name)), default_val)
        for name in names
    )


def filter_exp(exprs: list[str] | tuple[str, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names whose start matches any pattern, in name order, with duplicates.

    Logs a warning for patterns that match no name. Raises `ValueError` for a pattern that is not a
    valid regular expression.
    """
    _report_unmatched(exprs, names)
    compiled = [compile_pattern(expr) for expr in exprs]
    return tuple(name for name in names if any(pattern.match(name) for pattern in compiled))


def resolve_field(field: Any, names: tuple[str, ...], default_val: Any = None) -> tuple[Any, ...]:
    """Return one value per name: `resolve_expr` of a dict, else `field` for every name."""
    if isinstance(field, dict):
        return resolve_expr(field, names, default_val)
    return tuple(field for _ in names)


def unmatched_patterns(patterns: Iterable[str], names: Sequence[str]) -> list[str]:
    """Return the patterns that match the start of no name. Raises `ValueError` as `resolve_expr`."""
    return [p for p in patterns if not any(compile_pattern(p).match(name) for name in names)]


def compile_pattern(pattern: str) -> re.Pattern[str]:
    """Compile a regular expression. Raises `ValueError` with the pattern if it is not valid."""
    try:
        return re.compile(pattern)
    except re.error as error:
        raise ValueError(f"{pattern!r} is not a valid regular expression: {error}.") from error


def qualified_name(value: Any) -> str:
    """Return "module:qualified.name" of a class or function, or of the class of other values."""
    named = value if hasattr(value, "__qualname__") else type(value)
    # Methods of built-in classes have `__objclass__` instead of `__module__`.
    owner = getattr(named, "__objclass__", None) or getattr(named, "__self__", None)
    module = getattr(named, "__module__", None) or getattr(owner, "__module__", "builtins")
    return f"{module}:{named.__qualname__}"


def name_list(names: Sequence[str], near: Iterable[str]) -> str:
    """Return `names` for a message: all of a short list, else the names close to any of `near`.

    "['a', 'b']", or "['leg_1', 'leg_2'] and 198 others". If no name is close, lists the first names.
    """
    if len(names) <= _FEW:
        return str(list(names))
    close = [name for one in near for name in difflib.get_close_matches(one, names, n=_SHOWN)]
    shown = list(dict.fromkeys(close))[:_FEW] or list(names[:_SHOWN])
    return f"{shown} and {len(names) - len(shown)} others"


def escaped(text: object) -> str:
    """Return text that is shown as it is within a line of Markdown or HTML.

    Characters that could begin a tag, markup or a line become character references. For all names
    and messages shown in a page: they may come from the files of other people.
    """
    return _MARKUP.sub(lambda found: f"&#{ord(found[0])};", html.escape(str(text)))


def encodable(text: str) -> str:
    r"""Return text that UTF-8 can encode, for pages: odd bytes of a file's name read `\udcff`.

    Not `?`, so that names that differ in such bytes still differ.
    """
    return text.encode(errors="backslashreplace").decode()


def command_line(words: Iterable[str]) -> str:
    """Return a command line for the shell of this machine."""
    join = subprocess.list2cmdline if os.name == "nt" else shlex.join
    return join(list(words))


def is_number(text: str) -> bool:
    """Return True if `text` is a number, as `float` reads it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: "1 environment", "4,096 environments"."""
    return f"{count} {noun}" if count == 1 else f"{count:,} {noun}s"


def clock(seconds: float) -> str:
    """Format seconds as `2:41` or `1:02:41`."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def number(value: float) -> str:
    """Format a value with three digits, or without decimals: `7.41`, `741`, `3,704`."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def duration(seconds: float) -> str:
    """Format seconds: `8.4 s`, `3:05 min`, `2:10 h`."""
    if round(seconds, 1) < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}:{rest:02d} min"
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d} h"


def suggest(name: str, available: Iterable[str]) -> str:
    """Return a hint for an unknown `name`: "did you mean 'y'? Available: ['x', 'y']."."""
    names = list(available)
    listed = name_list(names, near=[name])
    close = difflib.get_close_matches(name, names, n=_SHOWN, cutoff=0.5)
    if not close:
        return f"available: {listed}."
    return f"did you mean {' or '.join(map(repr, close))}? Available: {listed}."


def _report_unmatched(patterns: Iterable[str], names: Sequence[str]) -> None:
    unmatched = unmatched_patterns(patterns, names)
    # Without names, patterns cannot match: the default ".*" for an entity without joints is valid.
    if names and unmatched:
        logger.warning(
            "Patterns %s match none of the names %s.", unmatched, name_list(names, near=unmatched)
        )
