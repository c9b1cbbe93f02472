"""Observation terms of the velocity task, about feet. They are for critics: robots do not know it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import accepts_older_params, older_names
from mjlab.managers.term_checks import checked_when_built, require_fields, require_sensor
from mjlab.sensor import BuiltinSensor, ContactSensor, TerrainHeightSensor

if TYPE_CHECKING:
    import mujoco

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

__all__ = [
    "foot_air_time",
    "foot_contact",
    "foot_contact_forces",
    "foot_height",
]


def check_found_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that asks whether there is contact."""
    require_fields(require_sensor(env, sensor_name, ContactSensor), "found")


def check_force_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads forces of contacts."""
    require_fields(require_sensor(env, sensor_name, ContactSensor), "force")


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


@accepts_older_params
@checked_when_built(check_height_sensor)
def foot_height(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Height of each foot above the ground (m), (N, feet), from a height sensor."""
    return env.scene[sensor_name].data.heights


@checked_when_built(check_air_time_sensor)
def foot_air_time(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Time that each foot has been in the air (s), (N, feet); 0 on the ground."""
    return env.scene[sensor_name].data.current_air_time


@checked_when_built(check_found_sensor)
def foot_contact(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """1 for each foot that touches the ground, else 0, (N, feet)."""
    return (env.scene[sensor_name].data.found > 0).float()


@checked_when_built(check_force_sensor)
def foot_contact_forces(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Contact forces as `sign(f) ln(1 + |f|)`, (N, 3 feet): x, y, z of the first foot, and so on.

    The logarithm brings standing (some 30 N a foot) and landing (some 1000 N) to one scale.
    """
    force = env.scene[sensor_name].data.force.flatten(start_dim=1)
    return torch.copysign(torch.log1p(force.abs()), force)


# Checks of further terms, for when they are built.


def check_feet_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads one contact for each foot."""
    sensor = require_sensor(env, sensor_name, ContactSensor)
    if sensor.cfg.num_slots != 1:
        raise ValueError(
            f"The contact sensor {sensor_name!r} has {sensor.cfg.num_slots} slots for each foot, "
            "and the term needs one. Set num_slots=1, with reduce='netforce' for the sum of all "
            "contacts of a foot."
        )
    require_fields(sensor, "found")


def check_builtin_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Check a term that reads a MuJoCo sensor of three numbers."""
    sensor = require_sensor(env, sensor_name, BuiltinSensor)
    size = sensor.data.shape[-1]
    if size != 3:
        raise ValueError(
            f"The sensor {sensor_name!r} has {size} values; one of 3 is needed, such as a "
            "subtreeangmom sensor."
        )


# Feet: columns of different sources that are multiplied with each other.


# What a source is called in messages, and name and body of each of its columns.
Source = tuple[str, list[tuple[str, int]]]


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


def check_same_feet(env: ManagerBasedRlEnv, one: Source, other: Source) -> None:
    """Raise `ValueError` unless the columns of two sources belong to the same feet, in order.

    Two columns belong together if they are on the same body, or one is on a part of the other's
    body.
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


__getattr__ = older_names(__name__)
