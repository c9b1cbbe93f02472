"""Fields of sub-terrain configs: refusing values that cannot be built, and ranges of difficulty."""

from __future__ import annotations

import math
from typing import Any


def refuse_unless(holds: bool, cfg: Any, field: str, rule: str) -> None:
    """Raise `ValueError`, which names the field and its value, unless `holds`."""
    if not holds:
        raise ValueError(f"{type(cfg).__name__}.{field} is {getattr(cfg, field)!r}; {rule}")


def refuse_unless_positive(cfg: Any, *fields: str) -> None:
    """Raise `ValueError` for the first of the fields that is not a positive, finite number."""
    for field in fields:
        value = getattr(cfg, field)
        refuse_unless(0.0 < value < math.inf, cfg, field, "it must be above 0.")


def refuse_unless_range(cfg: Any, field: str, lowest: float = -math.inf) -> None:
    """Raise `ValueError` unless the field is (low, high), finite, and not below `lowest`."""
    low, high = getattr(cfg, field)
    refuse_unless(
        math.isfinite(low) and math.isfinite(high) and low <= high,
        cfg,
        field,
        "it must be (low, high) with low <= high.",
    )
    refuse_unless(low >= lowest, cfg, field, f"it must not be below {lowest:g}.")


def lerp(ends: tuple[float, float], difficulty: float) -> float:
    """Return the value of a range at a difficulty: its low end at 0, its high end at 1."""
    return ends[0] + difficulty * (ends[1] - ends[0])
