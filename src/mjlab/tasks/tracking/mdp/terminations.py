"""Termination terms of motion tracking. Each returns bool (N,); limits themselves are no failure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.managers.term_checks import checked_when_built
from mjlab.tasks.tracking.mdp.commands import body_columns, check_motion_term, motion_command
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


@checked_when_built(check_motion_term)
def bad_anchor_pos(env: ManagerBasedRlEnv, command_name: str, threshold: float) -> torch.Tensor:
    """The robot's anchor is further from the reference's than `threshold` (m)."""
    command = motion_command(env, command_name)
    away = command.anchor_pos_w - command.robot_anchor_pos_w
    return torch.linalg.vector_norm(away, dim=1) > threshold


@checked_when_built(check_motion_term)
def bad_anchor_pos_z_only(
    env: ManagerBasedRlEnv, command_name: str, threshold: float
) -> torch.Tensor:
    """The robot's anchor is higher or lower than the reference's by more than `threshold` (m)."""
    command = motion_command(env, command_name)
    return (command.anchor_pos_w[:, 2] - command.robot_anchor_pos_w[:, 2]).abs() > threshold


@checked_when_built(check_motion_term)
def bad_anchor_ori(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg, command_name: str, threshold: float
) -> torch.Tensor:
    """The anchors differ in |g_z - g'_z| by more than `threshold`, whatever their headings.

    g and g' are the unit vectors down in the frames of the two anchors.
    """
    command = motion_command(env, command_name)
    return (_down(command.anchor_quat_w) - _down(command.robot_anchor_quat_w)).abs() > threshold


def _down(quat: torch.Tensor) -> torch.Tensor:
    """Return z of the unit vector down in frames of orientation (N, 4): 2 (x^2 + y^2) - 1."""
    x, y = quat[:, 1], quat[:, 2]
    return 2.0 * (x * x + y * y) - 1.0


@checked_when_built(check_motion_term)
def bad_motion_body_pos(
    env: ManagerBasedRlEnv, command_name: str, threshold: float, body_names: BodyNames = None
) -> torch.Tensor:
    """Any body (of `body_names`, or tracked) is further from its relative place than `threshold`."""
    command = motion_command(env, command_name)
    columns = body_columns(command, body_names)
    away = command.body_pos_relative_w[:, columns] - command.robot_body_pos_w[:, columns]
    return (torch.linalg.vector_norm(away, dim=-1) > threshold).any(dim=1)


@checked_when_built(check_motion_term)
def bad_motion_body_pos_z_only(
    env: ManagerBasedRlEnv, command_name: str, threshold: float, body_names: BodyNames = None
) -> torch.Tensor:
    """Any body (of `body_names`, or tracked) is above or below its place by more than `threshold`."""
    command = motion_command(env, command_name)
    columns = body_columns(command, body_names)
    away = command.body_pos_relative_w[:, columns, 2] - command.robot_body_pos_w[:, columns, 2]
    return (away.abs() > threshold).any(dim=1)


@checked_when_built(check_motion_term)
def motion_ended(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """The motion has no further frame. A time-out: nothing the robot did ended it.

    Without such a term the command puts the robot onto another frame in the middle of the episode,
    as mjlab 1.6 does, and the values that are learned span the jump.
    """
    command = motion_command(env, command_name)
    return command.time_steps >= command.motion.lengths[command.motion_ids] - 1


__getattr__ = older_names(__name__)
