"""Checks of terms: those a term function brings for the manager to make, and those terms share."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from mjlab.sensor import ContactSensor
from mjlab.utils.errors import WrongTypeError, check_exists, check_positive

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

F = TypeVar("F", bound=Callable[..., Any])
S = TypeVar("S")
_ATTRIBUTE = "check_when_built"


def checked_when_built(check: Callable[..., None]) -> Callable[[F], F]:
    """Decorator of term functions: `check(env, **params)` is called when a manager is built.

    `check` gets the parameters of the term's config, selections resolved, and raises `ValueError`,
    `KeyError` or `TypeError` if the term could not work with them. It should take `**_` for those
    that it does not look at.

    A class has its constructor for this. A function would notice a sensor that does not exist only
    at the first step, and columns in another order never.
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


# Scene and commands.


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
        check_exists("sensor", name, [n for n in sensors if not n.startswith(contacts)])
    sensor: Any = sensors[name]
    if not isinstance(sensor, kind):
        same_kind = [other for other, s in sensors.items() if isinstance(s, kind)]
        raise WrongTypeError(
            f"Sensor {name!r}: expected {kind.__name__}, got {type(sensor).__name__}. "
            f"Available: {same_kind}."
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
        raise ValueError(f"force_threshold: expected a force >= 0 (N), got {threshold!r}.")


def require_command(env: ManagerBasedRlEnv, name: str | None) -> None:
    """Raise `ValueError` unless there is a command of that name, or `name` is None."""
    if name is not None:
        check_exists("command", name, env.command_manager.active_terms)


# Values.


def check_std(std: float) -> None:
    """Raise `ValueError` unless a standard deviation is positive."""
    check_positive("std", std)


def check_range(label: str, bounds: Any) -> None:
    """Raise `ValueError` unless `bounds` are two finite numbers, the smaller one first."""
    try:
        low, high = (float(bound) for bound in bounds)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ValueError(f"{label}: expected finite (low, high) with low <= high, got {bounds!r}.")


def is_interval(bounds: Any) -> bool:
    """Return True for two real numbers (low, high) with low <= high, which NaN is not."""
    is_pair = isinstance(bounds, tuple | list) and len(bounds) == 2
    return is_pair and all(isinstance(b, Real) for b in bounds) and bounds[0] <= bounds[1]


def check_real(value: torch.Tensor, label: Callable[..., str], *args: Any) -> None:
    """Raise `TypeError` for complex numbers, and for a tensor without data (`meta`).

    torch would cast the former in silence, and fail on the latter without saying whose it is.
    `label(*args)` opens the message.
    """
    if value.is_complex() or value.is_meta:
        kind = "the device meta" if value.is_meta else str(value.dtype).removeprefix("torch.")
        raise WrongTypeError(f"{label(*args)}: expected real numbers, got a tensor of {kind}.")
