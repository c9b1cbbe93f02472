"""What the motion command logs of every episode: how far robot and reference are apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.utils.lab_api.math import quat_error_magnitude

if TYPE_CHECKING:
    from mjlab.tasks.tracking.mdp.motion_reader import MotionReader


def tracking_metrics(motion: MotionReader) -> dict[str, torch.Tensor]:
    """Return errors by name, (N,) each.

    Those of positions and velocities are Euclidean norms (m, m/s, rad/s), those of orientations
    angles (rad), those of bodies means over the tracked bodies, and those of joints the norm over
    all joints (rad, rad/s). Poses of bodies are compared with the relative ones; velocities are in
    world axes.
    """
    anchor = motion.anchor_index
    pos, quat = motion.robot_body_pos_w, motion.robot_body_quat_w
    # (3, N, K): of positions and both velocities.
    norms = _norm(
        torch.stack(
            (
                motion.body_pos_relative_w - pos,
                motion.body_lin_vel_w - motion.robot_body_lin_vel_w,
                motion.body_ang_vel_w - motion.robot_body_ang_vel_w,
            )
        )
    )
    mean_pos, mean_lin_vel, mean_ang_vel = norms.mean(dim=2)
    body_rot = quat_error_magnitude(motion.body_quat_relative_w, quat)
    return {
        "error_anchor_pos": _norm(motion.anchor_pos_w - pos[:, anchor]),
        "error_anchor_rot": quat_error_magnitude(motion.anchor_quat_w, quat[:, anchor]),
        "error_anchor_lin_vel": norms[1, :, anchor],
        "error_anchor_ang_vel": norms[2, :, anchor],
        "error_body_pos": mean_pos,
        "error_body_rot": body_rot.mean(dim=1),
        "error_body_lin_vel": mean_lin_vel,
        "error_body_ang_vel": mean_ang_vel,
        "error_joint_pos": (motion.joint_pos - motion.robot_joint_pos).norm(dim=-1),
        "error_joint_vel": (motion.joint_vel - motion.robot_joint_vel).norm(dim=-1),
    }


def _norm(vectors: torch.Tensor) -> torch.Tensor:
    """Return Euclidean norms of (..., 3) vectors."""
    # By components: a reduction over three numbers takes a CPU twice as long.
    x, y, z = vectors.unbind(-1)
    return (x * x).addcmul_(y, y).addcmul_(z, z).sqrt_()
