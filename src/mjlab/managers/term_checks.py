"""TODO."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from mjlab.sensor import ContactSensor
from mjlab.utils.string import name_list

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


# MERGED mjlab.managers.term_checks: Checks that a term which is a function brings along, for the manager to make when it is built.
#
# A class has its constructor for this. A function would notice a sensor that does not exist only at
# the first step, and columns in another order never.

F = TypeVar("F", bound=Callable[..., Any])
_ATTRIBUTE = "check_when_built"


def checked_when_built(check: Callable[..., None]) -> Callable[[F], F]:
    """Decorator of term functions: `check(env, **params)` is called when a manager is built.

    `check` gets the parameters of the term's config, selections resolved, and raises `ValueError`,
    `KeyError` or `TypeError` if the term could not work with them. It should take `**_` for those
    that it does not look at.
    """

    def mark(function: F) -> F:
        setattr(function, _ATTRIBUTE, check)
        return function

    return mark


def check_term(function: Any, env: ManagerBasedRlEnv, params: dict[str, Any]) -> None:
    """Make the check of a term's function, if it brings one."""
    check = getattr(function, _ATTRIBUTE, None)
    if check is not None:
        check(env, **params)


# MERGED mjlab.managers.term_checks: What terms of several tasks refuse when they are built: wrong names, sensors, ranges, numbers.

S = TypeVar("S")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return what to say about the names that exist: the nearest ones, or all if they are few."""
    names = list(known)
    close = difflib.get_close_matches(name, names)
    if close:
        return f"Did you mean {' or '.join(map(repr, close))}?"
    return f"There are: {name_list(names, near=())}."


def require_sensor(env: ManagerBasedRlEnv, name: str, kind: type[S]) -> S:
    """Return a sensor of the scene.

    Raises:
        ValueError: there is no such sensor; the message names the nearest ones.
        TypeError: it is of another kind.
    """
    sensors = env.scene.sensors
    if name not in sensors:
        # A contact sensor is made of MuJoCo's own, one for each of its parts, that nobody asks for.
        contacts = tuple(f"{n}_" for n, s in sensors.items() if isinstance(s, ContactSensor))
        known = [n for n in sensors if not n.startswith(contacts)]
        raise ValueError(f"The scene has no sensor {name!r}. {nearest(name, known)}")
    sensor: Any = sensors[name]
    if not isinstance(sensor, kind):
        same_kind = [other for other, s in sensors.items() if isinstance(s, kind)]
        raise TypeError(
            f"The sensor {name!r} is a {type(sensor).__name__}, and a {kind.__name__} is needed. "
            f"Such are: {same_kind}."
        )
    return sensor


def require_fields(sensor: ContactSensor, *fields: str) -> None:
    """Raise `ValueError` unless a contact sensor has all of these fields."""
    missing = [field for field in fields if field not in sensor.cfg.fields]
    if missing:
        raise ValueError(
            f"The contact sensor {sensor.cfg.name!r} has no {missing}. Add them to its fields, "
            f"which are {tuple(sensor.cfg.fields)}."
        )


def check_contact_sensor(env: ManagerBasedRlEnv, sensor_name: str, **params: Any) -> None:
    """Check a term that counts contacts, or forces in a history that exceed `force_threshold`."""
    sensor = require_sensor(env, sensor_name, ContactSensor)
    has_history = sensor.cfg.history_length > 0 and "force" in sensor.cfg.fields
    if not has_history:
        require_fields(sensor, "found")
    threshold = params.get("force_threshold", 0.0)
    if not threshold >= 0.0:
        raise ValueError(f"force_threshold is {threshold!r}; it is a force in newtons, at least 0.")


def require_command(env: ManagerBasedRlEnv, name: str | None) -> None:
    """Raise `ValueError` unless there is a command of that name, or `name` is None."""
    names = env.command_manager.active_terms
    if name is not None and name not in names:
        raise ValueError(f"There is no command {name!r}. {nearest(name, names)}")


def check_std(std: float) -> None:
    """Raise `ValueError` unless a standard deviation is positive."""
    if not std > 0.0:
        raise ValueError(f"std is {std!r}; it has to be positive.")


def check_range(label: str, bounds: Any) -> None:
    """Raise `ValueError` unless `bounds` are two finite numbers, the smaller one first."""
    try:
        low, high = (float(bound) for bound in bounds)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        turned = " They are the wrong way round." if low > high else ""
        raise ValueError(
            f"{label} is {bounds!r}; it has to be two finite numbers, the smaller one first.{turned}"
        )


# MERGED mjlab.managers.term_checks: Refusing tensors that torch would cast in silence, or fail on without saying whose they are.


def check_real(label: str, value: torch.Tensor) -> None:
    """Raise TypeError, with `label`, for complex numbers, and for a tensor without data (`meta`)."""
    if value.is_complex() or value.is_meta:
        kind = "the device meta" if value.is_meta else str(value.dtype).removeprefix("torch.")
        raise TypeError(f"{label}: expected real numbers, got a tensor of {kind}.")
