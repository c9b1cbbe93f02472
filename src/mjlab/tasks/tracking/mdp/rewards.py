"""Reward terms of motion tracking, exp(-E / std^2), (N,). The error E is 0 on the reference.

Body terms average over all tracked bodies, or over `body_names`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.envs.mdp.rewards import self_collision_cost as self_collision_cost
from mjlab.tasks.tracking.mdp.commands import body_columns, motion_command
from mjlab.utils.lab_api.math import quat_error_magnitude

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "motion_global_anchor_orientation_error_exp",
    "motion_global_anchor_position_error_exp",
    "motion_global_body_angular_velocity_error_exp",
    "motion_global_body_linear_velocity_error_exp",
    "motion_relative_body_orientation_error_exp",
    "motion_relative_body_position_error_exp",
]

BodyNames = tuple[str, ...] | None


def motion_global_anchor_position_error_exp(
    env: ManagerBasedRlEnv, command_name: str, std: float
) -> torch.Tensor:
    """Reward the anchor's position in the world: E is its squared distance (m^2)."""
    command = motion_command(env, command_name)
    error = (command.anchor_pos_w - command.robot_anchor_pos_w).square().sum(dim=-1)
    return torch.exp(error / -(std**2))


def motion_global_anchor_orientation_error_exp(
    env: ManagerBasedRlEnv, command_name: str, std: float
) -> torch.Tensor:
    """Reward the anchor's orientation in the world: E is the squared angle (rad^2)."""
    command = motion_command(env, command_name)
    angle = quat_error_magnitude(command.anchor_quat_w, command.robot_anchor_quat_w)
    return torch.exp(angle.square() / -(std**2))


def motion_relative_body_position_error_exp(
    env: ManagerBasedRlEnv, command_name: str, std: float, body_names: BodyNames = None
) -> torch.Tensor:
    """Reward body positions: E is the mean squared distance to the relative positions (m^2)."""
    command = motion_command(env, command_name)
    away = command.body_pos_relative_w - command.robot_body_pos_w
    return _rewarded(away, body_columns(command, body_names), std)


def motion_relative_body_orientation_error_exp(
    env: ManagerBasedRlEnv, command_name: str, std: float, body_names: BodyNames = None
) -> torch.Tensor:
    """Reward body orientations: E is the mean squared angle to the relative ones (rad^2)."""
    command = motion_command(env, command_name)
    angle = quat_error_magnitude(command.body_quat_relative_w, command.robot_body_quat_w)
    return _rewarded(angle.unsqueeze(-1), body_columns(command, body_names), std)


def motion_global_body_linear_velocity_error_exp(
    env: ManagerBasedRlEnv, command_name: str, std: float, body_names: BodyNames = None
) -> torch.Tensor:
    """Reward linear body velocities in world axes: E is the mean squared error (m^2/s^2)."""
    command = motion_command(env, command_name)
    error = command.body_lin_vel_w - command.robot_body_lin_vel_w
    return _rewarded(error, body_columns(command, body_names), std)


def motion_global_body_angular_velocity_error_exp(
    env: ManagerBasedRlEnv, command_name: str, std: float, body_names: BodyNames = None
) -> torch.Tensor:
    """Reward angular body velocities in world axes: E is the mean squared error (rad^2/s^2)."""
    command = motion_command(env, command_name)
    error = command.body_ang_vel_w - command.robot_body_ang_vel_w
    return _rewarded(error, body_columns(command, body_names), std)


def _rewarded(errors: torch.Tensor, columns: slice | torch.Tensor, std: float) -> torch.Tensor:
    """Return exp(-E / std^2), E: mean of |error|^2 over the selected bodies; `errors` (N, K, D)."""
    chosen = errors[:, columns]
    # Sum over bodies and components at once: a sum over three components takes four times as long.
    squares = chosen.square().flatten(1).sum(dim=1)
    return torch.exp(squares / -(chosen.shape[1] * std**2))


__getattr__ = older_names(__name__)
