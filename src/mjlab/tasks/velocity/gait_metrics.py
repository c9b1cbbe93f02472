"""Gait metrics of evaluations: torque, power, slip and smoothness, whatever the scale of actions.

Read between steps, when forces and contacts are those of the last physics substep.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from mjlab.tasks.velocity.mdp.observations import (
    check_feet_sensor,
    check_same_feet,
    contact_columns,
    height_columns,
)
from mjlab.utils.indexing import as_columns
from mjlab.utils.torch import constant_tensor

_ROBOT = "robot"
_CONTACTS = "feet_ground_contact"
_HEIGHTS = "foot_height_scan"


def joint_torque(env: Any) -> torch.Tensor:
    """Return the mean over joints of |tau|, (num_envs,), in N m: torque of their actuators."""
    return env.scene[_ROBOT].data.qfrc_actuator.abs().mean(dim=1)


def torque_share(env: Any) -> torch.Tensor:
    """Return the largest |force| / limit of any actuator, (num_envs,).

    Actuators without a force limit in the model count as 0.
    """
    robot, model = env.scene[_ROBOT], env.sim.mj_model
    ids = robot.indexing.actuator_ids.tolist()
    limits = [
        float(abs(model.actuator_forcerange[i]).max())
        if model.actuator_forcelimited[i]
        else math.inf
        for position, i in enumerate(ids)
        for _ in robot.indexing.force_columns([position])
    ]
    force = robot.data.actuator_force.abs()
    return (force / constant_tensor(tuple(limits), env.device)).amax(dim=1)


def mechanical_power(env: Any) -> torch.Tensor:
    """Return the sum over joints of |tau q_dot|, (num_envs,), in W."""
    data = env.scene[_ROBOT].data
    return (data.qfrc_actuator * data.joint_vel).abs().sum(dim=1)


def action_rate(env: Any) -> torch.Tensor:
    """Return the mean over actions of |a_t - a_(t-1)| times their scale, (num_envs,).

    For joint positions that is the change of the target in a step, in rad, before any clip.
    """
    manager = env.action_manager
    terms = [manager.get_term(name) for name in manager.active_terms]
    sizes = [term.action_dim for term in terms]
    changes = [
        change * term.scale
        for change, term in zip(
            (manager.action - manager.prev_action).split(sizes, dim=1), terms, strict=True
        )
    ]
    return torch.cat(changes, dim=1).abs().mean(dim=1)


def foot_slip(env: Any) -> torch.Tensor:
    """Return the mean horizontal speed of feet in contact, (num_envs,), in m/s; 0 in the air.

    Feet are the sites of `foot_height_scan`, and touch the ground where `feet_ground_contact` says so.

    Raises:
        ValueError: one of these sensors does not exist, or they are of other feet.
    """
    check_feet_sensor(env, _CONTACTS)
    feet = height_columns(env, _HEIGHTS)
    check_same_feet(
        env,
        (f"The contact sensor {_CONTACTS!r}", contact_columns(env, _CONTACTS)),
        (f"the height sensor {_HEIGHTS!r}", feet),
    )
    in_contact = env.scene[_CONTACTS].data.found > 0
    robot = env.scene[_ROBOT]
    sites = as_columns([robot.site_names.index(name) for name, _ in feet], env.device)
    speed = robot.data.site_lin_vel_w[:, sites, :2].norm(dim=-1)
    return (speed * in_contact).sum(dim=1) / in_contact.sum(dim=1).clamp(min=1)


GAIT_METRICS = {
    "joint_torque": joint_torque,
    "torque_share": torque_share,
    "mechanical_power": mechanical_power,
    "action_rate": action_rate,
    "foot_slip": foot_slip,
}
"""The metrics by the name under which evaluations report them."""
