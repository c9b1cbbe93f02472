"""What can be changed by sliders and boxes on the page of a terrain."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from mjlab.terrains import SubTerrainCfg

RobotName = Literal["unitree_go1", "unitree_g1", "none"]

Kind = Literal["number", "count", "range", "switch", "choice"]

# What the page, not a knob, decides, or what no slider can express.
_NOT_KNOBS = {"proportion", "size", "flat_patch_sampling"}
# Sizes of pixels: near 0 a height field would have millions of them.
_PIXELS = {"horizontal_scale", "vertical_scale", "resolution"}


@dataclass(frozen=True)
class Knob:
    """One field of a config, and how it is shown."""

    field: str
    """Name of the field."""
    kind: Kind
    """A float, an int, a pair of floats, a bool, or one of several words."""
    value: Any
    """What it is now."""
    low: float = 0.0
    """Lowest value of a slider."""
    high: float = 1.0
    """Highest value of a slider."""
    options: tuple[str, ...] = ()
    """The words of a choice."""


def knobs_of(cfg: SubTerrainCfg) -> list[Knob]:
    """Return the knobs of a config, in the order of its fields. Fields that are None have none."""
    hints = typing.get_type_hints(type(cfg))
    knobs = []
    for field in dataclasses.fields(cfg):
        if field.name in _NOT_KNOBS:
            continue
        knob = _knob(field.name, getattr(cfg, field.name), hints[field.name])
        if knob is not None:
            knobs.append(knob)
    return knobs


def _knob(name: str, value: Any, hint: Any) -> Knob | None:
    if isinstance(value, bool):
        return Knob(name, "switch", value)
    if typing.get_origin(hint) is Literal:
        return Knob(name, "choice", value, options=typing.get_args(hint))
    if isinstance(value, int):
        return Knob(name, "count", value, 1, 3 * max(value, 1))
    if isinstance(value, float):
        if name in _PIXELS:
            return Knob(name, "number", value, value / 2, 4 * value)
        return Knob(name, "number", value, min(0.0, 2 * value), max(1.0, 2 * value))
    if isinstance(value, tuple) and len(value) == 2:
        low, high = value
        return Knob(name, "range", value, min(0.0, 2 * low), max(2 * high, 0.1))
    return None


def with_values(cfg: SubTerrainCfg, values: dict[str, Any]) -> SubTerrainCfg:
    """Return a copy of the config with the values of knobs."""
    typed = {name: tuple(v) if isinstance(v, (list, tuple)) else v for name, v in values.items()}
    return dataclasses.replace(cfg, **typed)
