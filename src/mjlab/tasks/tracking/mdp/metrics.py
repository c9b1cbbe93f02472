"""How far robot and reference are apart, as evaluations report it.

Each function takes a motion command, or one of its frames (`MotionCommand.matching_frame`), and
returns a value for each environment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.tasks.tracking.mdp._shared import body_columns
from mjlab.utils.lab_api.math import quat_error_magnitude

if TYPE_CHECKING:
    from mjlab.tasks.tracking.mdp.motion_reader import MotionReader


def compute_mpkpe(command: MotionReader) -> torch.Tensor:
    """Return the mean distance of the tracked bodies to the reference in the world, (N,), in m."""
    return _distance(command.body_pos_w, command.robot_body_pos_w).mean(dim=1)


def compute_root_relative_mpkpe(command: MotionReader) -> torch.Tensor:
    """Return the mean distance of the tracked bodies to the relative reference, (N,), in m."""
    return _distance(command.body_pos_relative_w, command.robot_body_pos_w).mean(dim=1)


def compute_joint_velocity_error(command: MotionReader) -> torch.Tensor:
    """Return the root mean square over joints of the velocity error, (N,), in rad/s."""
    return (command.joint_vel - command.robot_joint_vel).square().mean(dim=1).sqrt()


def compute_ee_position_error(
    command: MotionReader, ee_body_names: tuple[str, ...]
) -> torch.Tensor:
    """Return the mean distance of some bodies to the relative reference, (N,), in m.

    No bodies have no error. Raises `ValueError` for a body that is not tracked.
    """
    if not ee_body_names:
        return torch.zeros(
            len(command.robot_joint_vel), dtype=torch.float32, device=command.body_indexes.device
        )
    columns = body_columns(command, ee_body_names)
    distance = _distance(command.body_pos_relative_w, command.robot_body_pos_w)
    return distance[:, columns].mean(dim=1)


def compute_ee_orientation_error(
    command: MotionReader, ee_body_names: tuple[str, ...]
) -> torch.Tensor:
    """Return the mean angle of some bodies to the relative reference, (N,), in rad.

    No bodies have no error. Raises `ValueError` for a body that is not tracked.
    """
    if not ee_body_names:
        return torch.zeros(
            len(command.robot_joint_vel), dtype=torch.float32, device=command.body_indexes.device
        )
    columns = body_columns(command, ee_body_names)
    angle = quat_error_magnitude(command.body_quat_relative_w, command.robot_body_quat_w)
    return angle[:, columns].mean(dim=1)


def _distance(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return torch.linalg.vector_norm(one - other, dim=-1)
