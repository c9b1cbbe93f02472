"""A fault of a robot's model: what, where, why it matters, and the cure."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from mjlab.utils.tables import WIDTH

_LISTED = 4


@dataclass(frozen=True)
class Finding:
    """Fault of a model."""

    fault: str
    """Name of the fault, a few words."""
    what: str
    """Elements and values."""
    where: tuple[str, ...]
    """`file:line` of each element, or its path in the model, or its setting in a config."""
    why: str
    """Consequence."""
    cure: str
    """Edit that helps."""

    def __str__(self) -> str:
        parts = {"at": _grouped(self.where), "why": self.why, "cure": self.cure}
        lines = [
            f"{self.fault}: {self.what}",
            *(f"    {key:<4} {text}" for key, text in parts.items()),
        ]
        return "\n".join(
            textwrap.fill(
                line,
                WIDTH,
                subsequent_indent=9 * " ",
                break_long_words=False,
                break_on_hyphens=False,
            )
            for line in lines
        )


def _grouped(where: Sequence[str]) -> str:
    """Return places, of those in one file its name once: `robot.xml:12, 20, 31`."""
    lines: dict[str, list[str]] = {}
    for place in dict.fromkeys(where):
        file, colon, line = place.rpartition(":")
        is_line = bool(colon) and line.isdigit()
        lines.setdefault(file if is_line else place, []).extend([line] if is_line else [])
    return ", ".join(f"{file}:{listed(own)}" if own else file for file, own in lines.items())


def listed(names: Sequence[object]) -> str:
    """Return the first names, and the number of the others."""
    rest = len(names) - _LISTED
    return ", ".join(map(str, [*names[:_LISTED], f"{rest} more"] if rest > 1 else names))
