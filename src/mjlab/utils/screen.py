"""Place of a config's field on the short help screen of a command."""

from __future__ import annotations

from typing import Any


def shown(heading: str, value: str = "", source: str | None = None) -> dict[str, Any]:
    """Return the metadata of a dataclass field that short help screens list.

    Args:
        heading: Purpose of the flag; flags with the same heading follow each other.
        value: Placeholder of the value, alternatives separated by `|`. Empty for a switch.
        source: Path in the command's config of the value used for None.
    """
    return {"screen": (heading, value, source)}
