"""What a function that changes the model declares: its fields, and what must be recomputed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from mjlab.sim.randomization import RecomputeLevel

F = TypeVar("F", bound=Callable[..., Any])


_DERIVED = {
    RecomputeLevel.set_const_fixed: ("body_subtreemass",),
    RecomputeLevel.set_const_0: (
        "dof_invweight0",
        "body_invweight0",
        "tendon_length0",
        "tendon_invweight0",
        "actuator_acc0",
    ),
}


def derived_fields(level: RecomputeLevel) -> tuple[str, ...]:
    """Return the model fields that recomputing at this level writes."""
    return tuple(f for part, fields in _DERIVED.items() if level & part for f in fields)


def join_levels(levels: Iterable[RecomputeLevel]) -> RecomputeLevel:
    """Return the level that recomputes what any of the given ones does."""
    joined = 0
    for level in levels:
        joined |= level
    return RecomputeLevel(joined)


def requires_model_fields(
    *fields: str, recompute: RecomputeLevel = RecomputeLevel.none
) -> Callable[[F], F]:
    """Declare that a function or class, used as an event, changes these fields of the model.

    The fields, and those that derive from them at the level `recompute`, then get a value for each
    environment, and the latter are recomputed after the event has fired.
    """

    def declare(function: F) -> F:
        declared = dict.fromkeys((*fields, *derived_fields(recompute)))
        setattr(function, "model_fields", tuple(declared))  # noqa: B010
        setattr(function, "recompute", RecomputeLevel(recompute))  # noqa: B010
        return function

    return declare


def declared_model_fields(function: Any, params: dict[str, Any]) -> tuple[str, ...]:
    """Return the model fields that an event's function declares.

    A function that learns from its parameters which field it changes declares a callable instead,
    which gets the parameters: `function.model_fields(params)`. So may `recompute`.
    """
    return tuple(_declared(function, "model_fields", params, ()))


def declared_recompute(function: Any, params: dict[str, Any]) -> RecomputeLevel:
    """Return the level of recomputation that an event's function declares."""
    return RecomputeLevel(_declared(function, "recompute", params, RecomputeLevel.none))


def _declared(function: Any, name: str, params: dict[str, Any], default: Any) -> Any:
    value = getattr(function, name, default)
    return value(params) if callable(value) else value
