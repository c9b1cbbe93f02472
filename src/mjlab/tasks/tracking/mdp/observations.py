"""Observation terms of motion tracking, in the frame of the robot's anchor body."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.tasks.tracking.mdp.commands import motion_command
from mjlab.utils.lab_api.math import quat_apply_inverse, quat_conjugate, quat_mul

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "motion_anchor_ori_b",
    "motion_anchor_pos_b",
    "robot_body_ori_b",
    "robot_body_pos_b",
]


def motion_anchor_pos_b(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Position of the reference anchor in the frame of the robot anchor (m), (N, 3)."""
    command = motion_command(env, command_name)
    offset = command.anchor_pos_w - command.robot_anchor_pos_w
    return quat_apply_inverse(command.robot_anchor_quat_w, offset)


def motion_anchor_ori_b(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Orientation of the reference anchor in the frame of the robot anchor, (N, 6).

    The first two columns of the rotation matrix, row by row.
    """
    command = motion_command(env, command_name)
    relative = quat_mul(quat_conjugate(command.robot_anchor_quat_w), command.anchor_quat_w)
    return _two_columns(relative)


def robot_body_pos_b(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Positions of the robot's tracked bodies in the frame of its anchor (m), (N, 3 K)."""
    command = motion_command(env, command_name)
    pos = command.robot_body_pos_w
    offset = pos - command.robot_anchor_pos_w[:, None]
    return quat_apply_inverse(command.robot_anchor_quat_w[:, None], offset).flatten(1)


def robot_body_ori_b(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Orientations of the robot's tracked bodies in the frame of its anchor, (N, 6 K).

    For each body, the first two columns of the rotation matrix, row by row.
    """
    command = motion_command(env, command_name)
    quat = command.robot_body_quat_w
    anchor = command.robot_anchor_quat_w[:, None]
    relative = quat_mul(quat_conjugate(anchor).expand_as(quat), quat)
    return _two_columns(relative).flatten(1)


def _two_columns(quat: torch.Tensor) -> torch.Tensor:
    """Return two columns of the rotation matrices of unit quaternions, row by row, (..., 6)."""
    # Contiguous components halve the time on a CPU.
    w, x, y, z = quat.movedim(-1, 0).contiguous()
    xy, wz, xz, wy, yz, wx = x * y, w * z, x * z, w * y, y * z, w * x
    yy, xx, zz = y * y, x * x, z * z
    rows = (0.5 - yy - zz, xy - wz, xy + wz, 0.5 - xx - zz, xz - wy, yz + wx)
    return torch.stack(rows).mul_(2.0).movedim(0, -1).contiguous()


__getattr__ = older_names(__name__)
