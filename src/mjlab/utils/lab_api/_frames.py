"""Poses as position (..., 3) and orientation (..., 4): combining, comparing, transforming."""

from __future__ import annotations

from typing import Literal

import torch

from mjlab.utils.lab_api._quaternions import (
    axis_angle_from_quat,
    quat_apply,
    quat_apply_inverse,
    quat_box_plus,
    quat_inv,
    quat_mul,
)


def combine_frame_transforms(
    t01: torch.Tensor,
    q01: torch.Tensor,
    t12: torch.Tensor | None = None,
    q12: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose of 2 in 0 from those of 1 in 0 and 2 in 1; None is zero or identity."""
    t02 = t01 if t12 is None else t01 + quat_apply(q01, t12)
    q02 = q01 if q12 is None else quat_mul(q01, q12)
    return t02, q02


def subtract_frame_transforms(
    t01: torch.Tensor,
    q01: torch.Tensor,
    t02: torch.Tensor | None = None,
    q02: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose of 2 in 1, from those of 1 and 2 in 0; None is zero or identity."""
    t12 = quat_apply_inverse(q01, -t01 if t02 is None else t02 - t01)
    q10 = quat_inv(q01)
    return t12, q10 if q02 is None else quat_mul(q10, q02)


def compute_pose_error(
    t01: torch.Tensor,
    q01: torch.Tensor,
    t02: torch.Tensor,
    q02: torch.Tensor,
    rot_error_type: Literal["quat", "axis_angle"] = "axis_angle",
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what takes pose 1 to pose 2: t02 - t01, and the rotation q02 * q01^-1.

    The rotation is in world axes, as a rotation vector (..., 3) or a quaternion ("quat"). Raises
    `ValueError` for another `rot_error_type`.
    """
    if rot_error_type not in ("quat", "axis_angle"):
        raise ValueError(
            f"rot_error_type is {rot_error_type!r}; it must be 'quat' or 'axis_angle'."
        )
    rotation = quat_mul(q02, quat_inv(q01))
    if rot_error_type == "axis_angle":
        rotation = axis_angle_from_quat(rotation)
    return t02 - t01, rotation


def apply_delta_pose(
    source_pos: torch.Tensor,
    source_rot: torch.Tensor,
    delta_pose: torch.Tensor,
    eps: float = 1.0e-6,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose moved by `delta_pose` (..., 6): a shift, then a rotation vector (world).

    Rotations by an angle of at most `eps` leave the orientation unchanged.
    """
    return source_pos + delta_pose[..., :3], quat_box_plus(source_rot, delta_pose[..., 3:6], eps)


def rigid_body_twist_transform(
    v0: torch.Tensor, w0: torch.Tensor, t01: torch.Tensor, q01: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return linear and angular velocity of a rigid body in another frame fixed to it.

    Args:
        v0: Linear velocity of the origin of frame 0, in frame 0.
        w0: Angular velocity, in frame 0.
        t01: Position of frame 1 in frame 0.
        q01: Orientation of frame 1 in frame 0.

    Returns both for the origin of frame 1, in frame 1.
    """
    v1 = quat_apply_inverse(q01, v0 + torch.linalg.cross(w0, t01))
    return v1, quat_apply_inverse(q01, w0)


def transform_points(
    points: torch.Tensor, pos: torch.Tensor | None = None, quat: torch.Tensor | None = None
) -> torch.Tensor:
    """Return points given in a frame in the frame's surroundings: R(quat) point + pos.

    Args:
        points: (P, 3), or (N, P, 3).
        pos: Position of the frame, (3,) or (N, 3); None for zero.
        quat: Orientation of the frame, (4,) or (N, 4); None for identity.

    Returns (P, 3), or (N, P, 3) where any argument has N.
    """
    is_batched = points.dim() == 3 or any(
        part is not None and part.dim() == 2 for part in (pos, quat)
    )
    for part in (pos, quat):
        if part is not None and part.dim() == 2 and points.dim() == 2:
            points = points.expand(part.shape[0], *points.shape)
    if quat is not None:
        per_point = quat.unsqueeze(-2) if quat.dim() == 2 else quat
        points = quat_apply(per_point.expand(*points.shape[:-1], 4), points)
    if pos is not None:
        points = points + (pos.unsqueeze(-2) if is_batched and pos.dim() == 2 else pos)
    return points


def is_identity_pose(pos: torch.Tensor, rot: torch.Tensor) -> bool:
    """Return whether all poses, (..., 3) and (..., 4), are (nearly) the identity."""
    no_shift = torch.allclose(pos, torch.zeros_like(pos))
    # q and -q are the same rotation.
    identity = torch.zeros_like(rot)
    identity[..., 0] = 1.0
    sign = torch.where(rot[..., :1] < 0, -1.0, 1.0)
    return no_shift and torch.allclose(rot * sign, identity)
