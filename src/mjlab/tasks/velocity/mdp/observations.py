"""Foot observation terms of the velocity task. Privileged: for critics, not available on robots."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import torch

from mjlab.compat import accepts_older_params, older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.sensor import ContactSensor, RayCastSensor

if TYPE_CHECKING:
    import mujoco

    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "foot_air_time",
    "foot_contact",
    "foot_contact_forces",
    "foot_height",
]


@accepts_older_params
def foot_height(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Height of each foot above the terrain (m), (N, feet)."""
    return env.scene[sensor_name].data.heights


def foot_air_time(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Time since lift-off of each foot (s), (N, feet); 0 in contact."""
    return env.scene[sensor_name].data.current_air_time


def foot_contact(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """1 for each foot in contact, else 0, (N, feet)."""
    return (env.scene[sensor_name].data.found > 0).float()


def foot_contact_forces(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Contact forces `sign(f) ln(1 + |f|)`, f in N: x, y, z of the first foot, and so on, (N, 3 feet).

    The logarithm reduces the range from standing (about 30 N per foot) to landing (about 1000 N).
    """
    force = env.scene[sensor_name].data.force.flatten(start_dim=1)
    return torch.copysign(torch.log1p(force.abs()), force)


# Order of the feet.


def check_same_feet(
    env: ManagerBasedRlEnv, feet: str | SceneEntityCfg, other: str | SceneEntityCfg
) -> None:
    """Warn unless two sources list the same feet in the same order.

    Sources are contact sensors and ray sensors by name, and selections of sites; any other source is not
    checked. Two columns are of one foot if they are on the same body, or one is on a descendant of the
    other's body.
    """
    bodies, others = foot_bodies(env, feet), foot_bodies(env, other)
    if bodies is None or others is None:
        return
    model = env.sim.mj_model
    if len(bodies) == len(others) and all(
        _is_within(model, a, b) or _is_within(model, b, a)
        for a, b in zip(bodies, others, strict=True)
    ):
        return
    names = [[model.body(body).name for body in source] for source in (bodies, others)]
    warnings.warn(
        f"Columns of {feet} and {other}: expected the same feet in the same order, got those of the "
        f"bodies {names[0]} and {names[1]}; contacts and sites are in model order, heights in the "
        "order of the sensor's frames.",
        UserWarning,
        stacklevel=2,
    )


def foot_bodies(env: ManagerBasedRlEnv, feet: str | SceneEntityCfg) -> list[int] | None:
    """Return the id of the body of each foot of a sensor or of selected sites; None if unknown."""
    if isinstance(feet, SceneEntityCfg):
        sites = env.scene[feet.name].indexing.site_ids[columns_of(feet, "site", env)]
        return env.sim.mj_model.site_bodyid[sites.tolist()].tolist()
    sensor = env.scene[feet]
    if isinstance(sensor, RayCastSensor):
        return sensor.frame_bodies
    if not isinstance(sensor, ContactSensor):
        return None
    model = env.sim.mj_model
    ids = [model.sensor(f"{feet}_{name}").objid.item() for name in sensor.primary_names]
    return model.geom_bodyid[ids].tolist() if sensor.cfg.primary.mode == "geom" else ids


def _is_within(model: mujoco.MjModel, body: int, tree: int) -> bool:
    """Return True if `body` is `tree` or a descendant of `tree`."""
    while body > 0 and body != tree:
        body = int(model.body_parentid[body])
    return body == tree


__getattr__ = older_names(__name__)
