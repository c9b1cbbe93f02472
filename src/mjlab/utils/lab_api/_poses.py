"""Poses as homogeneous matrices (..., 4, 4): making, inverting, interpolating."""

from __future__ import annotations

import math

import torch

from mjlab.utils.lab_api._basics import matrix_product
from mjlab.utils.lab_api._conversions import (
    matrix_from_euler,
    matrix_from_quat,
    quat_from_matrix,
)
from mjlab.utils.lab_api._quaternions import (
    axis_angle_from_quat,
    quat_from_angle_axis,
    quat_slerp,
)


def make_pose(pos: torch.Tensor, rot: torch.Tensor) -> torch.Tensor:
    """Return poses (..., 4, 4) from positions (..., 3) and rotation matrices (..., 3, 3).

    Raises `ValueError` if the leading sizes differ.
    """
    if pos.shape[:-1] != rot.shape[:-2] or pos.shape[-1] != 3 or rot.shape[-2:] != (3, 3):
        raise ValueError(
            f"make_pose got positions {tuple(pos.shape)} and rotations {tuple(rot.shape)}; "
            "expected (..., 3) and (..., 3, 3) with equal leading sizes."
        )
    pose = torch.zeros(*pos.shape[:-1], 4, 4, dtype=pos.dtype, device=pos.device)
    pose[..., :3, :3] = rot
    pose[..., :3, 3] = pos
    pose[..., 3, 3] = 1.0
    return pose


def unmake_pose(pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the positions (..., 3) and rotation matrices (..., 3, 3) of poses (..., 4, 4)."""
    return pose[..., :3, 3], pose[..., :3, :3]


def pose_inv(pose: torch.Tensor) -> torch.Tensor:
    """Return the inverse of poses (..., 4, 4)."""
    pos, rot = unmake_pose(pose)
    back = rot.transpose(-1, -2)
    return make_pose(-(back * pos.unsqueeze(-2)).sum(dim=-1), back)


def pose_in_A_to_pose_in_B(pose_in_A: torch.Tensor, pose_A_in_B: torch.Tensor) -> torch.Tensor:
    """Return a pose given in frame A in frame B, whose pose of A is `pose_A_in_B`."""
    return matrix_product(pose_A_in_B, pose_in_A)


def transform_poses_from_frame_A_to_frame_B(
    src_poses: torch.Tensor, frame_A: torch.Tensor, frame_B: torch.Tensor
) -> torch.Tensor:
    """Return poses that stand to frame B as `src_poses` stand to frame A.

    Args:
        src_poses: (N, 4, 4), in the world.
        frame_A: Pose of A in the world, (4, 4).
        frame_B: Pose of B in the world, (4, 4).
    """
    return matrix_product(frame_B, matrix_product(pose_inv(frame_A), src_poses))


def interpolate_rotations(
    R1: torch.Tensor, R2: torch.Tensor, num_steps: int, axis_angle: bool = True
) -> torch.Tensor:
    """Return rotation matrices from R1 to R2 at equal steps, (num_steps + 1, 3, 3).

    Args:
        R1: First, (3, 3).
        R2: Last, (3, 3).
        num_steps: Number of steps.
        axis_angle: Turn about one axis; False interpolates quaternions, which is the same path.

    Raises `ValueError` for fewer than one step.
    """
    if num_steps < 1:
        raise ValueError(f"num_steps is {num_steps}; it must be at least 1.")
    fractions = [step / num_steps for step in range(num_steps)]
    if axis_angle:
        vector = axis_angle_from_quat(quat_from_matrix(matrix_product(R2, R1.transpose(-1, -2))))
        angle = torch.linalg.vector_norm(vector) * R1.new_tensor(fractions)
        turns = matrix_from_quat(quat_from_angle_axis(angle, vector.expand(num_steps, 3)))
        steps = matrix_product(turns, R1)
    else:
        q1, q2 = quat_from_matrix(R1), quat_from_matrix(R2)
        steps = matrix_from_quat(torch.stack([quat_slerp(q1, q2, tau) for tau in fractions]))
    return torch.cat((steps, R2.unsqueeze(0)))


def interpolate_poses(
    pose_1: torch.Tensor,
    pose_2: torch.Tensor,
    num_steps: int | None = None,
    step_size: float | None = None,
    perturb: bool = False,
) -> tuple[torch.Tensor, int]:
    """Return both poses with poses between them, and the number of those between.

    Args:
        pose_1: First, (4, 4).
        pose_2: Last, (4, 4).
        num_steps: Number of poses between; or give
        step_size: Largest distance (m) between positions, from which their number follows.
        perturb: Shift the positions between at random along the path, by up to half a step.

    Returns (number between + 2, 4, 4) and that number. Raises `ValueError` unless exactly one of
    `num_steps` and `step_size` is given.
    """
    if (num_steps is None) == (step_size is None):
        raise ValueError(
            f"Give either num_steps or step_size (got num_steps={num_steps}, "
            f"step_size={step_size})."
        )
    (pos_1, rot_1), (pos_2, rot_2) = unmake_pose(pose_1), unmake_pose(pose_2)
    if num_steps is None:
        num_steps = math.ceil(float(torch.linalg.vector_norm(pos_2 - pos_1)) / (step_size or 1.0))
    intervals = num_steps + 1
    grid = torch.arange(intervals + 1, dtype=pos_1.dtype, device=pos_1.device)
    if perturb:
        grid[1:-1] += torch.rand(num_steps, dtype=grid.dtype, device=grid.device) - 0.5
    positions = pos_1 + (grid / intervals).unsqueeze(-1) * (pos_2 - pos_1)
    return make_pose(positions, interpolate_rotations(rot_1, rot_2, intervals)), num_steps


def generate_random_rotation(rot_boundary: float = 2 * math.pi) -> torch.Tensor:
    """Return a rotation matrix (3, 3) from Euler angles uniform in [0, rot_boundary)."""
    return matrix_from_euler(torch.rand(3, dtype=torch.float32) * rot_boundary, "XYZ")


def generate_random_translation(pos_boundary: float = 1) -> torch.Tensor:
    """Return a translation (3,), uniform in [-pos_boundary, pos_boundary)."""
    return (torch.rand(3, dtype=torch.float32) * 2.0 - 1.0) * pos_boundary


def generate_random_transformation_matrix(
    pos_boundary: float = 1, rot_boundary: float = 2 * math.pi
) -> torch.Tensor:
    """Return a pose (4, 4) from a random translation and a random rotation, as above."""
    return make_pose(
        generate_random_translation(pos_boundary), generate_random_rotation(rot_boundary)
    )
