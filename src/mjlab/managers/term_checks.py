"""Checks of term parameters, run when managers are built."""

from __future__ import annotations

import contextlib
import inspect
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from mjlab.sensor import ContactSensor, Sensor
from mjlab.utils.errors import UnknownNameError, WrongTypeError, check_exists

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

F = TypeVar("F", bound=Callable[..., Any])
S = TypeVar("S")
_ATTRIBUTE = "check_when_built"


def checked_when_built(check: Callable[..., object]) -> Callable[[F], F]:
    """Decorate a term function: managers call `check(env, **params)` when they are built.

    `check` receives the resolved parameters of the term's config and raises `ValueError`,
    `KeyError` or `TypeError` if they are invalid. Use `**_` for parameters that are not checked.

    Classes check in their constructor. A function would otherwise detect a missing sensor only at
    the first step, and columns in the wrong order never.
    """

    def mark(function: F) -> F:
        setattr(function, _ATTRIBUTE, check)
        return function

    return mark


def check_term(function: Any, env: ManagerBasedRlEnv, params: dict[str, Any]) -> None:
    """Run the check attached to a term function by `checked_when_built`, if any."""
    check = getattr(function, _ATTRIBUTE, None)
    if check is None:
        return
    if getattr(getattr(function, "__wrapped__", None), _ATTRIBUTE, None) is check:
        # Copied by `functools.wraps` to a decorated term, perhaps with other parameters.
        try:
            inspect.signature(check).bind(env, **params)
        except TypeError:
            return
    check(env, **params)


# Scene and commands.


def require_entity(env: ManagerBasedRlEnv, name: str) -> Entity:
    """Return an entity of the scene; raises `KeyError`, also for the name of a sensor."""
    # Scenes in tests of packages may be plain dicts.
    scene: Any = env.scene
    entity: Any = None
    with contextlib.suppress(KeyError):
        entity = scene[name]
    if entity is None or isinstance(entity, Sensor):
        check_exists("entity", name, getattr(scene, "entities", scene), UnknownNameError)
    return entity


def require_sensor(env: ManagerBasedRlEnv, name: str, kind: type[S]) -> S:
    """Return a sensor of the scene.

    Raises:
        ValueError: unknown sensor; the message suggests close names.
        TypeError: the sensor is not of type `kind`.
    """
    sensors = env.scene.sensors
    if name not in sensors:
        # The MuJoCo sensors of a contact sensor, one per primary, are not offered.
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
    """Raise `ValueError` unless a contact sensor has all `fields`."""
    missing = [field for field in fields if field not in sensor.cfg.fields]
    if missing:
        raise ValueError(
            f"Contact sensor {sensor.cfg.name!r} fields: expected {missing}, got "
            f"{tuple(sensor.cfg.fields)}; add the missing fields."
        )


def require_command(env: ManagerBasedRlEnv, name: str | None) -> None:
    """Raise `ValueError` unless `name` is a command or None."""
    if name is not None:
        check_exists("command", name, env.command_manager.active_terms)


# Values.


def check_range(name: str, bounds: Any) -> None:
    """Raise `ValueError` unless `bounds` is (low, high), finite, with low <= high."""
    try:
        low, high = (float(bound) for bound in bounds)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ValueError(f"{name}: expected finite (low, high) with low <= high, got {bounds!r}.")


def check_real(value: torch.Tensor, label: Callable[..., str], *args: Any) -> None:
    """Raise `TypeError` for complex tensors and for tensors without data (`meta`).

    torch would cast complex values silently, and fail on `meta` tensors without naming the term.
    The message starts with `label(*args)`.
    """
    if value.is_complex() or value.is_meta:
        kind = "device meta" if value.is_meta else str(value.dtype).removeprefix("torch.")
        raise WrongTypeError(f"{label(*args)}: expected real numbers, got a tensor of {kind}.")
