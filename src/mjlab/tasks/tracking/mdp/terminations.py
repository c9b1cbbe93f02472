"""Termination terms of motion tracking, (N,) bool. Thresholds are strict (`>`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.tasks.tracking.mdp.commands import body_columns, motion_command
from mjlab.utils.lab_api.math import quat_apply_inverse as quat_apply_inverse

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

__all__ = [
    "bad_anchor_ori",
    "bad_anchor_pos",
    "bad_anchor_pos_z_only",
    "bad_motion_body_pos",
    "bad_motion_body_pos_z_only",
    "motion_ended",
]

BodyNames = tuple[str, ...] | None


def bad_anchor_pos(env: ManagerBasedRlEnv, command_name: str, threshold: float) -> torch.Tensor:
    """Terminate if the distance of robot anchor and reference anchor exceeds `threshold` (m)."""
    command = motion_command(env, command_name)
    offset = command.anchor_pos_w - command.robot_anchor_pos_w
    return torch.linalg.vector_norm(offset, dim=1) > threshold


def bad_anchor_pos_z_only(
    env: ManagerBasedRlEnv, command_name: str, threshold: float
) -> torch.Tensor:
    """Terminate if robot and reference anchor heights differ by over `threshold` (m)."""
    command = motion_command(env, command_name)
    return (command.anchor_pos_w[:, 2] - command.robot_anchor_pos_w[:, 2]).abs() > threshold


def bad_anchor_ori(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg, command_name: str, threshold: float
) -> torch.Tensor:
    """Terminate if |g_z - g'_z| > `threshold`, independent of heading.

    g and g' are gravity directions (unit vectors) in the frames of reference and robot anchor.
    """
    command = motion_command(env, command_name)
    return (_down(command.anchor_quat_w) - _down(command.robot_anchor_quat_w)).abs() > threshold


def _down(quat: torch.Tensor) -> torch.Tensor:
    """Return z of the gravity direction in frames of orientation (N, 4): 2 (x^2 + y^2) - 1."""
    x, y = quat[:, 1], quat[:, 2]
    return 2.0 * (x * x + y * y) - 1.0


def bad_motion_body_pos(
    env: ManagerBasedRlEnv, command_name: str, threshold: float, body_names: BodyNames = None
) -> torch.Tensor:
    """Terminate if a body of `body_names` (None: all) is over `threshold` (m) off its reference.

    The reference is the relative position.
    """
    command = motion_command(env, command_name)
    columns = body_columns(command, body_names)
    offset = command.body_pos_relative_w[:, columns] - command.robot_body_pos_w[:, columns]
    return (torch.linalg.vector_norm(offset, dim=-1) > threshold).any(dim=1)


def bad_motion_body_pos_z_only(
    env: ManagerBasedRlEnv, command_name: str, threshold: float, body_names: BodyNames = None
) -> torch.Tensor:
    """Terminate if a body of `body_names` (None: all) is over `threshold` (m) off its height.

    The height is that of the relative position.
    """
    command = motion_command(env, command_name)
    columns = body_columns(command, body_names)
    offset = command.body_pos_relative_w[:, columns, 2] - command.robot_body_pos_w[:, columns, 2]
    return (offset.abs() > threshold).any(dim=1)


def motion_ended(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """End the episode at the last frame of the motion. Use as a time-out: the robot did not fail.

    Without this term the command moves the robot to a new frame in the middle of the episode, as in
    mjlab 1.6, and value estimates bootstrap across the jump.
    """
    command = motion_command(env, command_name)
    return command.time_steps >= command.motion.lengths[command.motion_ids] - 1


__getattr__ = older_names(__name__)
