"""Python source of names, tuples and dicts, for the files of a written package."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence

WIDTH = 100


def literal(value: object) -> str:
    """Return the source of a value: strings in double quotes, numbers with four digits."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        return number(value)
    if isinstance(value, tuple):
        items = ", ".join(map(literal, value))
        return f"({items},)" if len(value) == 1 else f"({items})"
    return repr(value)


def number(value: float, digits: int = 4) -> str:
    """Return the source of a float with some significant digits."""
    if value == 0.0 or not math.isfinite(value):
        return "0.0" if value == 0.0 else f'float("{value}")'
    return repr(float(f"{value:.{digits}g}"))


def tuple_source(items: Sequence[object], before: int = 0) -> str:
    """Return the source of a tuple, one item per line if it does not fit behind `before` characters."""
    line = literal(tuple(items))
    if before + len(line) <= WIDTH:
        return line
    return "(\n" + "".join(f"    {literal(item)},\n" for item in items) + ")"


def dict_source(
    values: Mapping[str, object], comments: Mapping[str, str] | None = None, indent: int = 0
) -> str:
    """Return the source of a dict, one item per line, with a comment behind each value."""
    space, lines = " " * indent, []
    for key, value in values.items():
        line = f"{space}    {literal(key)}: {literal(value)},"
        reason = (comments or {}).get(key, "")
        lines.append(commented(line, reason))
    return "{\n" + "\n".join(lines) + f"\n{space}}}"


def commented(line: str, reason: str) -> str:
    """Return a line with a comment behind it, or above it if both do not fit in one line."""
    if not reason:
        return line
    if len(line) + 4 + len(reason) <= WIDTH:
        return f"{line}  # {reason}"
    space = line[: len(line) - len(line.lstrip())]
    return "\n".join([*comment_lines(reason, len(space)), line])


def comment_lines(text: str, indent: int = 0) -> list[str]:
    """Return a comment, wrapped."""
    space, lines, words = " " * indent + "#", [], text.split()
    line = space
    for word in words:
        if len(line) + 1 + len(word) > WIDTH and line != space:
            lines.append(line)
            line = space
        line += " " + word
    return [*lines, line]


def pattern(names: Iterable[str], among: Iterable[str]) -> str:
    """Return a regular expression that matches `names`, of all names `among`, and no other.

    `.*_knee` if the names have a common end that no other name has; else the names themselves.
    """
    chosen, others = list(names), set(among)
    if len(chosen) > 1 and set(chosen) == others:
        return ".*"
    if len(chosen) > 1:
        candidate = ".*" + _escaped(_common_end(chosen))
        # Initial states match at the start of names, actions match whole names.
        for expression in (candidate, candidate + "$"):
            if {name for name in others if re.match(expression, name)} == set(chosen):
                return expression
    is_start = any(o.startswith(n) for n in chosen for o in others if o not in chosen)
    return "|".join(map(_escaped, chosen)).join(("(", ")$") if is_start else ("", ""))


def _common_end(names: list[str]) -> str:
    """Return the longest common end that begins with a separator or a capital letter."""
    end = names[0]
    while end and not (re.match(r"[_\-./ A-Z]", end) and all(n.endswith(end) for n in names)):
        end = end[1:]
    return end


def _escaped(name: str) -> str:
    # Spaces and hyphens have no meaning outside of classes, and are read more easily as they are.
    return re.sub(r"([^\w\s-])", r"\\\1", name)
