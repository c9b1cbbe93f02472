"""Observation terms that a robot cannot measure: one table, by function and by MuJoCo sensor.

`describe` marks these terms, and a policy to be deployed should not observe them. A critic may: only
training evaluates it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from mjlab.utils.tables import Table, function_name

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers import ObservationTermCfg

_VELOCITY = "velocity of the base in the world: needs a state estimator"
_POSITION = "position in the world: needs motion capture or odometry"
_SCAN = "heights of the terrain: need a depth sensor and a map"
_OBJECT = "pose of an object: needs a camera that tracks it"
_CONTACT = "contact of the feet: needs a switch or force sensor in each foot"
_DYNAMICS = "masses and their velocities: known to the simulation only"

UNMEASURED_FUNCTIONS = {
    "base_lin_vel": _VELOCITY,
    "root_lin_vel_w": _VELOCITY,
    "root_link_lin_vel_b": _VELOCITY,
    "base_pos_z": _POSITION,
    "root_pos_w": _POSITION,
    "body_pose_w": _POSITION,
    "motion_anchor_pos_b": _POSITION,
    "height_scan": _SCAN,
    "foot_height": _SCAN,
    "foot_air_time": _CONTACT,
    "foot_contact": _CONTACT,
    "foot_contact_forces": _CONTACT,
    "ee_to_object_distance": _OBJECT,
    "object_to_goal_distance": _OBJECT,
    "camera_segmentation": "object of each pixel: needs a segmentation network",
    "camera_target_cube_mask": "pixels of the object: need a segmentation network",
}
"""Reason by name of the term's function. Packages give functions of the same meaning the same name."""

UNMEASURED_SENSORS = {
    "velocimeter": _VELOCITY,
    "framelinvel": _VELOCITY,
    "framepos": _POSITION,
    "subtreecom": _DYNAMICS,
    "subtreelinvel": _DYNAMICS,
    "subtreeangmom": _DYNAMICS,
    "e_potential": _DYNAMICS,
    "e_kinetic": _DYNAMICS,
}
"""Reason by type of the MuJoCo sensor that a term of `builtin_sensor` reads."""

# Relative to another frame of the robot, they follow from joint positions and velocities.
_RELATIVE = ("framepos", "framelinvel")


def why_unmeasured(term: ObservationTermCfg, model: mujoco.MjModel) -> str | None:
    """Return the reason why a robot cannot measure a term; None if it can, or if the term is unknown.

    Args:
        term: Config of the term.
        model: Compiled scene, for the type of the sensor that the term reads.
    """
    name = function_name(term.func)
    if name == "builtin_sensor":
        return _why_sensor_unmeasured(term.params["sensor_name"], model)
    return UNMEASURED_FUNCTIONS.get(name)


def _why_sensor_unmeasured(sensor_name: str, model: mujoco.MjModel) -> str | None:
    sensor = model.sensor(sensor_name)
    kind = mujoco.mjtSensor(int(sensor.type[0])).name.removeprefix("mjSENS_").lower()
    if kind in _RELATIVE and int(sensor.refid[0]) >= 0:
        return None
    return UNMEASURED_SENSORS.get(kind)


def unmeasured_table(env: ManagerBasedRlEnv) -> Table:
    """Return the observation terms that a robot cannot measure: group, term and reason."""
    manager, model = env.observation_manager, env.sim.mj_model
    rows = [
        (group, term, reason)
        for group, terms in manager.active_terms.items()
        for term in terms
        if (reason := why_unmeasured(manager.get_term_cfg(group, term), model)) is not None
    ]
    return Table("unmeasured", ("group", "term", "reason"), rows, note="not measured by a robot")
