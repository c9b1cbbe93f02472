"""What the terms of a walking robot ask of its sensors and commands, checked when they are built."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TypeVar

from mjlab.sensor import BuiltinSensor, ContactSensor, TerrainHeightSensor
from mjlab.utils.string import name_list

if TYPE_CHECKING:
    import mujoco

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

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


def require_command(env: ManagerBasedRlEnv, name: str | None) -> None:
    """Raise `ValueError` unless there is a command of that name, or `name` is None."""
    names = env.command_manager.active_terms
    if name is not None and name not in names:
        raise ValueError(f"There is no command {name!r}. {nearest(name, names)}")


def check_std(std: float) -> None:
    """Raise `ValueError` unless a standard deviation is positive."""
    if not std > 0.0:
        raise ValueError(f"std is {std!r}; it has to be positive.")


def check_builtin_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads a MuJoCo sensor of three numbers."""
    sensor = require_sensor(env, sensor_name, BuiltinSensor)
    size = sensor.data.shape[-1]
    if size != 3:
        raise ValueError(
            f"The sensor {sensor_name!r} has {size} values; one of 3 is needed, such as a "
            "subtreeangmom sensor."
        )


def _require_fields(sensor: ContactSensor, *fields: str) -> None:
    missing = [field for field in fields if field not in sensor.cfg.fields]
    if missing:
        raise ValueError(
            f"The contact sensor {sensor.cfg.name!r} has no {missing}. Add them to its fields, "
            f"which are {tuple(sensor.cfg.fields)}."
        )


def check_contact_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that counts contacts, or forces in a history."""
    sensor = require_sensor(env, sensor_name, ContactSensor)
    has_history = sensor.cfg.history_length > 0 and "force" in sensor.cfg.fields
    if not has_history:
        _require_fields(sensor, "found")


def check_found_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that asks whether there is contact."""
    _require_fields(require_sensor(env, sensor_name, ContactSensor), "found")


def check_force_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads forces of contacts."""
    _require_fields(require_sensor(env, sensor_name, ContactSensor), "force")


def check_air_time_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads air times, or landings of feet."""
    if not require_sensor(env, sensor_name, ContactSensor).cfg.track_air_time:
        raise ValueError(
            f"The contact sensor {sensor_name!r} does not track air time. Set track_air_time=True "
            "in its config."
        )


def check_height_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads one height for each foot."""
    if require_sensor(env, sensor_name, TerrainHeightSensor).cfg.reduction == "none":
        raise ValueError(
            f"The height sensor {sensor_name!r} has reduction='none', one height for each ray. "
            "One for each foot is needed: 'min', 'max' or 'mean'."
        )


def check_feet_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads one contact for each foot."""
    sensor = require_sensor(env, sensor_name, ContactSensor)
    if sensor.cfg.num_slots != 1:
        raise ValueError(
            f"The contact sensor {sensor_name!r} has {sensor.cfg.num_slots} slots for each foot, "
            "and the term needs one. Set num_slots=1, with reduce='netforce' for the sum of all "
            "contacts of a foot."
        )
    _require_fields(sensor, "found")


def check_landing_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads the force with which feet land."""
    check_air_time_sensor(env, sensor_name)
    check_feet_sensor(env, sensor_name)
    check_force_sensor(env, sensor_name)


# Feet: columns of different sources that are multiplied with each other.


def contact_columns(env: ManagerBasedRlEnv, sensor_name: str) -> list[tuple[str, int]]:
    """Return name and body of each column of a contact sensor."""
    sensor = require_sensor(env, sensor_name, ContactSensor)
    primary = sensor.cfg.primary
    kind = "geom" if primary.mode == "geom" else "body"
    return [_element(env, kind, name, primary.entity) for name in sensor.primary_names]


def height_columns(env: ManagerBasedRlEnv, sensor_name: str) -> list[tuple[str, int]]:
    """Return name and body of each column of a height sensor: its frames, in order."""
    check_height_sensor(env, sensor_name)
    frame = require_sensor(env, sensor_name, TerrainHeightSensor).cfg.frame
    frames = frame if isinstance(frame, tuple) else (frame,)
    return [_element(env, ref.type, ref.name, ref.entity) for ref in frames]


def site_columns(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> list[tuple[str, int]]:
    """Return name and body of each selected site."""
    entity = env.scene.entities[asset_cfg.name]
    names = entity.site_names if asset_cfg.site_names is None else asset_cfg.site_names
    if not names:
        raise ValueError(
            f"asset_cfg selects no site of entity {asset_cfg.name!r}; give the sites of the feet "
            "as site_names."
        )
    return [_element(env, "site", name, asset_cfg.name) for name in names]


def check_same_feet(
    env: ManagerBasedRlEnv,
    one: tuple[str, list[tuple[str, int]]],
    other: tuple[str, list[tuple[str, int]]],
) -> None:
    """Raise `ValueError` unless the columns of two sources belong to the same feet, in order.

    Two columns belong together if they are on the same body, or one is on a part of the other's
    body. Each source is what it is called, and its columns.
    """
    (label, columns), (other_label, other_columns) = one, other
    model = env.sim.mj_model
    fits = len(columns) == len(other_columns) and all(
        _is_within(model, a, b) or _is_within(model, b, a)
        for (_, a), (_, b) in zip(columns, other_columns, strict=True)
    )
    if not fits:
        raise ValueError(
            f"{label} has the columns {[name for name, _ in columns]} and {other_label} has "
            f"{[name for name, _ in other_columns]}; they are multiplied with each other, so they "
            "have to be the same feet in the same order. Contacts and sites follow the order of "
            "the model, heights the order of the sensor's frames."
        )


def _element(env: ManagerBasedRlEnv, kind: str, name: str, entity: str | None) -> tuple[str, int]:
    """Return the name of an element, and the id of the body it is on."""
    model = env.sim.mj_model
    full = name if entity is None or name.startswith(f"{entity}/") else f"{entity}/{name}"
    if kind in ("body", "xbody"):
        return name, int(model.body(full).id)
    element: Any = getattr(model, kind)(full)
    return name, int(element.bodyid[0])


def _is_within(model: mujoco.MjModel, body: int, tree: int) -> bool:
    """Return whether `body` is `tree` or below it."""
    while body > 0 and body != tree:
        body = int(model.body_parentid[body])
    return body == tree
