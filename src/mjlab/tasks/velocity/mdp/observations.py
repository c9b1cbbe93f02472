"""Foot observation terms of the velocity task. Privileged: for critics, not available on robots."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

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
    """Raise unless `sensor_name` is a contact sensor with the field `found`."""
    require_fields(require_sensor(env, sensor_name, ContactSensor), "found")


def check_force_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Raise unless `sensor_name` is a contact sensor with the field `force`."""
    require_fields(require_sensor(env, sensor_name, ContactSensor), "force")


def check_air_time_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Raise unless `sensor_name` is a contact sensor that tracks air time."""
    if not require_sensor(env, sensor_name, ContactSensor).cfg.track_air_time:
        raise ValueError(
            f"Contact sensor {sensor_name!r} track_air_time: expected True, got False; the term uses air times."
        )


def check_height_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Raise unless `sensor_name` is a height sensor with one height per frame."""
    if require_sensor(env, sensor_name, TerrainHeightSensor).cfg.reduction == "none":
        raise ValueError(
            f"Height sensor {sensor_name!r} reduction: expected 'min', 'max' or 'mean', one height per "
            "frame, got reduction='none', one height per ray."
        )


@accepts_older_params
@checked_when_built(check_height_sensor)
def foot_height(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Height of each foot above the terrain (m), (N, feet)."""
    return env.scene[sensor_name].data.heights


@checked_when_built(check_air_time_sensor)
def foot_air_time(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Time since lift-off of each foot (s), (N, feet); 0 in contact."""
    return env.scene[sensor_name].data.current_air_time


@checked_when_built(check_found_sensor)
def foot_contact(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """1 for each foot in contact, else 0, (N, feet)."""
    return (env.scene[sensor_name].data.found > 0).float()


@checked_when_built(check_force_sensor)
def foot_contact_forces(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Contact forces `sign(f) ln(1 + |f|)`, f in N: x, y, z of the first foot, and so on, (N, 3 feet).

    The logarithm reduces the range from standing (about 30 N per foot) to landing (about 1000 N).
    """
    force = env.scene[sensor_name].data.force.flatten(start_dim=1)
    return torch.copysign(torch.log1p(force.abs()), force)


# Checks of reward terms and metrics.


def check_feet_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Raise unless `sensor_name` is a contact sensor with `found` and one slot per foot."""
    sensor = check_one_slot(env, sensor_name)
    require_fields(sensor, "found")


def check_one_slot(env: ManagerBasedRlEnv, sensor_name: str) -> ContactSensor:
    """Return a contact sensor; raise unless it has one slot per foot."""
    sensor = require_sensor(env, sensor_name, ContactSensor)
    if sensor.cfg.num_slots != 1:
        raise ValueError(
            f"Contact sensor {sensor_name!r} num_slots: expected 1 slot per foot, got "
            f"{sensor.cfg.num_slots}; use reduce='netforce' for the sum of all contacts of a foot."
        )
    return sensor


def check_builtin_sensor(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    """Raise unless `sensor_name` is a MuJoCo sensor with three values."""
    sensor = require_sensor(env, sensor_name, BuiltinSensor)
    size = sensor.data.shape[-1]
    if size != 3:
        raise ValueError(
            f"Sensor {sensor_name!r}: expected 3 values, got {size}; use e.g. a subtreeangmom sensor."
        )


# Foot columns of sensors and site selections.


class Source(NamedTuple):
    """Columns of a sensor or of a selection of sites."""

    name: str
    """Name for messages."""
    columns: list[tuple[str, int]]
    """Name and body id of each column."""


def contact_columns(env: ManagerBasedRlEnv, sensor_name: str) -> Source:
    """Return the columns of a contact sensor with one slot per foot."""
    check_feet_sensor(env, sensor_name)
    sensor = require_sensor(env, sensor_name, ContactSensor)
    primary = sensor.cfg.primary
    kind = "geom" if primary.mode == "geom" else "body"
    columns = [_element(env, kind, name, primary.entity) for name in sensor.primary_names]
    return Source(f"contact sensor {sensor_name!r}", columns)


def height_columns(env: ManagerBasedRlEnv, sensor_name: str) -> Source:
    """Return the columns of a height sensor, in the order of its frames."""
    check_height_sensor(env, sensor_name)
    frame = require_sensor(env, sensor_name, TerrainHeightSensor).cfg.frame
    frames = frame if isinstance(frame, tuple) else (frame,)
    columns = [_element(env, ref.type, ref.name, ref.entity) for ref in frames]
    return Source(f"height sensor {sensor_name!r}", columns)


def site_columns(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> Source:
    """Return the columns of a selection of sites."""
    entity = env.scene.entities[asset_cfg.name]
    names = entity.site_names if asset_cfg.site_names is None else asset_cfg.site_names
    if not names:
        raise ValueError(
            f"asset_cfg.site_names: expected the foot sites of entity {asset_cfg.name!r}, got none."
        )
    columns = [_element(env, "site", name, asset_cfg.name) for name in names]
    return Source("asset_cfg.site_names", columns)


def check_same_feet(env: ManagerBasedRlEnv, source: Source, other: Source) -> None:
    """Warn unless the columns of two sources belong to the same feet, in order.

    Two columns match if they are on the same body, or one is on a descendant of the other's body.
    Raises `ValueError` if the numbers of columns differ, unless one is 1, used for all feet.
    """
    model = env.sim.mj_model
    counts = len(source.columns), len(other.columns)
    if counts[0] == counts[1] and all(
        _is_within(model, a, b) or _is_within(model, b, a)
        for (_, a), (_, b) in zip(source.columns, other.columns, strict=True)
    ):
        return
    message = (
        f"Columns of {source.name} and {other.name}: expected the same feet in the same order, got "
        f"{[name for name, _ in source.columns]} and {[name for name, _ in other.columns]}. "
        "Contacts and sites are in model order, heights in the order of the sensor's frames."
    )
    if counts[0] != counts[1] and 1 not in counts:
        raise ValueError(message)
    warnings.warn(message, UserWarning, stacklevel=2)


def _element(env: ManagerBasedRlEnv, kind: str, name: str, entity: str | None) -> tuple[str, int]:
    """Return the name of an element and the id of its body."""
    model = env.sim.mj_model
    full = name if entity is None or name.startswith(f"{entity}/") else f"{entity}/{name}"
    if kind in ("body", "xbody"):
        return name, int(model.body(full).id)
    element: Any = getattr(model, kind)(full)
    return name, int(element.bodyid[0])


def _is_within(model: mujoco.MjModel, body: int, tree: int) -> bool:
    """Return True if `body` is `tree` or a descendant of `tree`."""
    while body > 0 and body != tree:
        body = int(model.body_parentid[body])
    return body == tree


__getattr__ = older_names(__name__)
