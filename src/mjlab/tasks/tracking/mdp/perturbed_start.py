"""The state in which a robot starts on a frame of a motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch

from mjlab.utils.lab_api.math import quat_from_euler_xyz, quat_mul, sample_uniform
from mjlab.utils.torch import constant_tensor

if TYPE_CHECKING:
    from mjlab.tasks.tracking.mdp.motion_loader import MotionLibrary

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""What a range of poses or velocities may name."""


def perturbed_start(
    motion: MotionLibrary,
    frames: torch.Tensor,
    *,
    pose_range: Mapping[str, tuple[float, float]],
    velocity_range: Mapping[str, tuple[float, float]],
    joint_position_range: tuple[float, float],
    scale: float = 1.0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return states on frames (n,), with uniform perturbations.

    Positions and velocities are added to, p + (x, y, z) and v + (x, y, z), w + (roll, pitch, yaw);
    orientations are turned in world axes, q_euler(roll, pitch, yaw) q. Numbers are drawn in the
    order pose, velocity, joints, and multiplied by `scale`. The root is the first of the tracked bodies.

    Returns:
        Root states (n, 13), without origins of environments, and joint positions (n, nj).
    """
    count, device = len(frames), str(frames.device)
    pos, quat, lin_vel, ang_vel = (
        of_bodies[:, 0].index_select(0, frames)
        for of_bodies in (
            motion.body_pos_w, motion.body_quat_w, motion.body_lin_vel_w, motion.body_ang_vel_w
        )
    )  # fmt: skip
    joint_pos = motion.joint_pos[frames]
    pose = scale * _drawn(pose_range, count, device)
    turn = quat_from_euler_xyz(*pose[:, 3:].unbind(1))
    velocity = scale * _drawn(velocity_range, count, device)
    joints = scale * sample_uniform(*joint_position_range, tuple(joint_pos.shape), device)
    root_state = torch.cat(
        (
            pos + pose[:, :3],
            quat_mul(turn, quat),
            lin_vel + velocity[:, :3],
            ang_vel + velocity[:, 3:],
        ),
        dim=1,
    )
    return root_state, joint_pos + joints


def _drawn(ranges: Mapping[str, tuple[float, float]], count: int, device: str) -> torch.Tensor:
    bounds = zip(*(ranges.get(axis, (0.0, 0.0)) for axis in AXES), strict=True)
    low, high = (constant_tensor(side, device) for side in bounds)
    return sample_uniform(low, high, (count, len(AXES)), device)
