"""What all spec editors share: their interface, and values given per name pattern."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco


@dataclass(kw_only=True)
class SpecCfg(ABC):
    """A change to an MjSpec, described by data."""

    @abstractmethod
    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Make the change. Raises `ValueError` if the description is not valid."""

    def validate(self) -> None:
        """Raise `ValueError`, saying which value is not valid and what is allowed."""
        return


def check_values(owner: SpecCfg, field: str, is_valid: Callable[[Any], bool], allowed: str) -> None:
    """Raise `ValueError` unless each value of a field (scalar, or dict by pattern) is valid."""
    for pattern, value in _values_by_pattern(getattr(owner, field)):
        if value is not None and not is_valid(value):
            where = "" if pattern is None else f" for pattern {pattern!r}"
            raise ValueError(
                f"{type(owner).__name__}.{field} is {value!r}{where}; it must be {allowed}."
            )


def _values_by_pattern(value: Any) -> Iterator[tuple[str | None, Any]]:
    if isinstance(value, dict):
        yield from value.items()
    else:
        yield None, value


def mujoco_enum(owner: SpecCfg, field: str, choices: dict[str, Any]) -> Any:
    """Return MuJoCo's constant for a field that names it. `ValueError` lists the choices."""
    value = getattr(owner, field)
    if value not in choices:
        raise ValueError(
            f"{type(owner).__name__}.{field} is {value!r}; it must be one of {list(choices)}."
        )
    return choices[value]


def find_body(owner: SpecCfg, spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody:
    """Return the body of that name ("world" is the world). `ValueError` lists the bodies."""
    body = spec.worldbody if name == "world" else spec.body(name)
    if body is None:
        raise ValueError(
            f"{type(owner).__name__} refers to the body {name!r}, which does not exist. "
            f"Bodies: {[body.name for body in spec.bodies]}."
        )
    return body
