"""Gait metrics of evaluations: torque, power, slip, clearance, bobbing and smoothness, independent of the
action scale.

Evaluated between environment steps; forces and contacts are those of the last physics substep.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

import torch

from mjlab.tasks.velocity.mdp.observations import check_same_feet
from mjlab.utils.indexing import as_columns
from mjlab.utils.torch import constant_tensor

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.actions.actions import BaseAction

_ROBOT = "robot"
_CONTACTS = "feet_ground_contact"
_HEIGHTS = "foot_height_scan"


def joint_torque(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the mean actuator torque |tau| over joints (N m), (num_envs,)."""
    return env.scene[_ROBOT].data.qfrc_actuator.abs().mean(dim=1)


def torque_share(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the maximum of |force| / limit over actuators, (num_envs,).

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


def mechanical_power(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the sum of |tau q_dot| over joints (W), (num_envs,)."""
    data = env.scene[_ROBOT].data
    return (data.qfrc_actuator * data.joint_vel).abs().sum(dim=1)


def action_rate(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the mean of scale |a_t - a_(t-1)| over actions, (num_envs,).

    For joint position actions: change of the target per step (rad), before clipping.
    """
    manager = env.action_manager
    terms = [cast("BaseAction", manager.get_term(name)) for name in manager.active_terms]
    sizes = [term.action_dim for term in terms]
    changes = [
        change * term.scale
        for change, term in zip(
            (manager.action - manager.prev_action).split(sizes, dim=1), terms, strict=True
        )
    ]
    return torch.cat(changes, dim=1).abs().mean(dim=1)


def foot_slip(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the mean horizontal speed of feet in contact (m/s), (num_envs,); 0 without contact.

    Foot velocities are those of the sites of `foot_height_scan`, contacts those of
    `feet_ground_contact`.

    Warns if the two sensors measure different feet.
    """
    check_same_feet(env, _CONTACTS, _HEIGHTS)
    in_contact = env.scene[_CONTACTS].data.found > 0
    robot = env.scene[_ROBOT]
    feet = env.scene[_HEIGHTS].cfg.frame
    sites = as_columns([robot.site_names.index(foot.name) for foot in feet], env.device)
    speed = robot.data.site_lin_vel_w[:, sites, :2].norm(dim=-1)
    return (speed * in_contact).sum(dim=1) / in_contact.sum(dim=1).clamp(min=1)


def foot_clearance(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the maximum height of the feet above the ground (m), (num_envs,). Dragging feet have about 0."""
    return env.scene[_HEIGHTS].data.heights.amax(dim=1)


def trunk_bobbing(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Return the vertical speed |v_z| of the root link (m/s), (num_envs,)."""
    return env.scene[_ROBOT].data.root_link_lin_vel_w[:, 2].abs()


GAIT_METRICS = {
    "joint_torque": joint_torque,
    "torque_share": torque_share,
    "mechanical_power": mechanical_power,
    "action_rate": action_rate,
    "foot_slip": foot_slip,
    "foot_clearance": foot_clearance,
    "trunk_bobbing": trunk_bobbing,
}
"""Gait metrics by their names in evaluations."""
