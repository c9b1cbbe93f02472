"""Batched math: rotations, poses, random samples and pinhole cameras.

Functions are batched over leading axes. Quaternions are (w, x, y, z) with the Hamilton product; angles
are in radians; rotation vectors are axis times angle. Pinhole cameras look along +z with x to the right
and y down: with intrinsic matrix K, pixel (u, v) at depth z is the point z K^-1 (u, v, 1). Pixel (0, 0)
is the upper left one; u counts along a row.

Functions that take and return tensors compile with `torch.jit.script`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from typing import Any, Literal, TypeVar

import numpy as np
import torch

from mjlab.utils.errors import check_one_of
from mjlab.utils.torch import constant_tensor

__all__ = [
    "apply_delta_pose",
    "axis_angle_from_quat",
    "combine_frame_transforms",
    "compute_pose_error",
    "convert_camera_frame_orientation_convention",
    "convert_quat",
    "copysign",
    "create_rotation_matrix_from_view",
    "default_orientation",
    "euler_xyz_from_quat",
    "generate_random_rotation",
    "generate_random_transformation_matrix",
    "generate_random_translation",
    "interpolate_poses",
    "interpolate_rotations",
    "is_identity_pose",
    "make_pose",
    "matrix_from_euler",
    "matrix_from_quat",
    "matrix_product",
    "normalize",
    "orthogonalize_perspective_depth",
    "pose_in_A_to_pose_in_B",
    "pose_inv",
    "project_points",
    "quat_apply",
    "quat_apply_inverse",
    "quat_apply_yaw",
    "quat_box_minus",
    "quat_box_plus",
    "quat_conjugate",
    "quat_error_magnitude",
    "quat_from_angle_axis",
    "quat_from_euler_xyz",
    "quat_from_matrix",
    "quat_inv",
    "quat_mul",
    "quat_rotate",
    "quat_rotate_inverse",
    "quat_slerp",
    "quat_unique",
    "random_orientation",
    "random_yaw_orientation",
    "rigid_body_twist_transform",
    "sample_cylinder",
    "sample_gaussian",
    "sample_log_uniform",
    "sample_ranges",
    "sample_triangle",
    "sample_uniform",
    "saturate",
    "scale_transform",
    "skew_symmetric_matrix",
    "subtract_frame_transforms",
    "transform_points",
    "transform_poses_from_frame_A_to_frame_B",
    "unmake_pose",
    "unproject_depth",
    "unscale_transform",
    "wrap_to_pi",
    "yaw_quat",
]
ArrayT = TypeVar("ArrayT", torch.Tensor, np.ndarray)
Size = int | tuple[int, ...]
# Camera axes (columns) of each convention in OpenGL camera axes (looking along -z, up is +y).
_IN_OPENGL = {
    "opengl": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    # Looks along +z, up is -y.
    "ros": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    # Looks along +x, up is +z.
    "world": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
}


# Quaternions.


def quat_mul(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return q1 * q2: rotate by q2, then by q1. `ValueError` unless the shapes are equal."""
    if q1.shape != q2.shape:
        raise ValueError(
            f"quat_mul: expected equal shapes, got {list(q1.shape)} and {list(q2.shape)}; expand "
            "one of them."
        )
    # Each component of q1 times all of q2: 16 operations, instead of 29 component by component.
    product = q1[..., :1] * q2
    # Not `unbind`: autograd does not allow writes to its views.
    w, x, y, z = product[..., 0], product[..., 1], product[..., 2], product[..., 3]
    xw, xx, xy, xz = (q1[..., 1:2] * q2).unbind(-1)
    w -= xx
    x += xw
    y -= xz
    z += xy
    yw, yx, yy, yz = (q1[..., 2:3] * q2).unbind(-1)
    w -= yy
    x += yz
    y += yw
    z -= yx
    zw, zx, zy, zz = (q1[..., 3:] * q2).unbind(-1)
    w -= zz
    x -= zy
    y += zx
    z += zw
    return product.contiguous()


def quat_conjugate(q: torch.Tensor) -> torch.Tensor:
    """Return (w, -x, -y, -z)."""
    conjugate = -q
    conjugate[..., 0] = q[..., 0]
    return conjugate


def quat_inv(q: torch.Tensor, eps: float = 1e-9) -> torch.Tensor:
    """Return the inverse of quaternions of any norm: conjugate / max(norm^2, eps)."""
    return quat_conjugate(q) / q.square().sum(dim=-1, keepdim=True).clamp(min=eps)


def quat_unique(q: torch.Tensor) -> torch.Tensor:
    """Return the quaternion of the same rotation with w >= 0."""
    return torch.where(q[..., :1] < 0, -q, q)


def quat_apply(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors: R(q) v.

    Args:
        quat: Unit quaternions, one per vector or one for all, (..., 4).
        vec: Vectors, (..., 3).

    Returns a tensor of the shape of `vec`. Raises `ValueError` for incompatible shapes.
    """
    return _rotate(_fit_to(quat, vec), vec, sign=1)


def quat_apply_inverse(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors by the inverse: R(q)' v. Arguments and errors as in `quat_apply`."""
    return _rotate(_fit_to(quat, vec), vec, sign=-1)


quat_rotate = quat_apply
quat_rotate_inverse = quat_apply_inverse


def quat_apply_yaw(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors by the yaw of the quaternions only."""
    return quat_apply(yaw_quat(quat), vec)


def yaw_quat(quat: torch.Tensor) -> torch.Tensor:
    """Return the rotation about z by the yaw angle of the quaternions, (..., 4)."""
    w, x, y, z = quat.unbind(-1)
    half = 0.5 * torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    zero = torch.zeros_like(half)
    return torch.stack((torch.cos(half), zero, zero, torch.sin(half)), dim=-1)


def _rotate(quat: torch.Tensor, vec: torch.Tensor, sign: int) -> torch.Tensor:
    """Return v + 2 (s w c + xyz x c) with c = xyz x v; sign s = -1 gives the inverse rotation."""
    w, xyz = quat[..., :1], quat[..., 1:]
    cross = torch.linalg.cross(xyz, vec)
    change = torch.linalg.cross(xyz, cross).addcmul_(w, cross, value=sign)
    return torch.add(vec, change, alpha=2)


def _fit_to(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Reshape `quat` such that its leading sizes broadcast to those of `vec`."""
    if quat.shape[-1] == 4 and vec.shape[-1] == 3:
        if quat.shape[:-1] == vec.shape[:-1]:
            return quat
        num_quats = quat.numel() // 4
        if num_quats == 1:
            return quat.reshape([1] * (vec.dim() - 1) + [4])
        if num_quats == vec.numel() // 3:
            return quat.reshape(list(vec.shape[:-1]) + [4])
        fits = quat.dim() == vec.dim()
        for axis in range(vec.dim() - 1):
            fits = fits and quat.shape[axis] in [1, vec.shape[axis]]
        if fits:
            return quat
    raise ValueError(
        "Expected vectors (..., 3) and quaternions (..., 4), one per vector or one for all, got "
        f"shapes {list(vec.shape)} and {list(quat.shape)}."
    )


def quat_from_angle_axis(angle: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return the rotation by `angle` (...) rad about `axis` (..., 3). Normalizes `axis`."""
    half = 0.5 * angle.unsqueeze(-1)
    direction = normalize(axis)
    vector = direction * torch.sin(half)
    # Normalized because the axis may have zero length.
    return normalize(torch.cat((torch.cos(half).expand_as(vector[..., :1]), vector), dim=-1))


def axis_angle_from_quat(quat: torch.Tensor, eps: float = 1.0e-6) -> torch.Tensor:
    """Return the rotation vector, axis times angle in [0, pi], (..., 3).

    If sin(angle / 2) <= `eps`, uses the series of angle / sin(angle / 2).
    """
    quat = quat_unique(quat)
    real, vector = quat[..., :1], quat[..., 1:]
    sine = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, real)
    is_small = sine <= eps
    # Divisor 1 for entries that use the series, to keep gradients finite.
    ratio = angle / torch.where(is_small, 1.0, sine)
    return vector * torch.where(is_small, 2.0 + angle.square() / 12.0, ratio)


def quat_box_minus(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return log(q1 * conj(q2)), the rotation vector from q2 to q1 in world axes."""
    return axis_angle_from_quat(quat_mul(q1, quat_conjugate(q2)))


def quat_box_plus(q: torch.Tensor, delta: torch.Tensor, eps: float = 1.0e-6) -> torch.Tensor:
    """Return exp(delta) * q: rotate q by the rotation vector `delta` (..., 3) in world axes.

    Rotations by an angle of at most `eps` leave q unchanged.
    """
    angle = torch.linalg.vector_norm(delta, dim=-1)
    turned = quat_mul(quat_from_angle_axis(angle, delta), q)
    return torch.where(angle.unsqueeze(-1) > eps, turned, q)


def quat_error_magnitude(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return the angle between two unit quaternions in [0, pi], (...)."""
    # Chords of the unit sphere are cheap, and precise for small angles: |q1 - q2| = 2 sin(angle / 4)
    # and |q1 + q2| = 2 cos(angle / 4), or the reverse if q1 and q2 are in opposite hemispheres.
    away = torch.linalg.vector_norm(q1 - q2, dim=-1)
    along = torch.linalg.vector_norm(q1 + q2, dim=-1)
    return 4.0 * torch.atan2(torch.minimum(away, along), torch.maximum(away, along))


def quat_slerp(q1: torch.Tensor, q2: torch.Tensor, tau: float) -> torch.Tensor:
    """Interpolate along the shortest path between two quaternions, (4,) each, from q1 (tau = 0) to q2.

    (Nearly) equal rotations give q1. The arguments are unchanged. Raises `ValueError` for wrong
    shapes.
    """
    if list(q1.shape) != [4] or list(q2.shape) != [4]:
        raise ValueError(
            f"quat_slerp: expected two quaternions of shape (4,), got {list(q1.shape)} and "
            f"{list(q2.shape)}."
        )
    if tau == 0.0:
        return q1.clone()
    if tau == 1.0:
        return q2.clone()
    target = torch.where(torch.dot(q1, q2) < 0, -q2, q2)
    # Unlike the arc cosine, precise for small angles.
    angle = 2.0 * torch.atan2((q1 - target).norm(), (q1 + target).norm())
    sine = torch.sin(angle)
    if sine <= 4.0 * torch.finfo(q1.dtype).eps:
        return q1.clone()
    return (torch.sin((1.0 - tau) * angle) * q1 + torch.sin(tau * angle) * target) / sine


# Conversions between quaternions, matrices and Euler angles.


def convert_quat(quat: ArrayT, to: Literal["xyzw", "wxyz"] = "xyzw") -> ArrayT:
    """Reorder quaternions (..., 4) from (w, x, y, z) to (x, y, z, w), or back.

    Raises `ValueError` for an unknown target or a wrong last size.
    """
    check_one_of("to", to, ("xyzw", "wxyz"))
    if quat.shape[-1] != 4:
        raise ValueError(f"quat: expected shape (..., 4), got {tuple(quat.shape)}.")
    shift = -1 if to == "xyzw" else 1
    roll: Any = torch.roll if isinstance(quat, torch.Tensor) else np.roll
    return roll(quat, shift, -1)


def matrix_from_quat(quaternions: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) of quaternions of any nonzero norm."""
    w, x, y, z = quaternions.unbind(-1)
    s = 2.0 / quaternions.square().sum(dim=-1)
    entries = (
        1.0 - s * (y * y + z * z),
        s * (x * y - z * w),
        s * (x * z + y * w),
        s * (x * y + z * w),
        1.0 - s * (x * x + z * z),
        s * (y * z - x * w),
        s * (x * z - y * w),
        s * (y * z + x * w),
        1.0 - s * (x * x + y * y),
    )
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def quat_from_matrix(matrix: torch.Tensor) -> torch.Tensor:
    """Return the quaternions (..., 4) of rotation matrices (..., 3, 3).

    The component of largest magnitude is positive, so w can be negative. Raises `ValueError` for a
    wrong shape.
    """
    if list(matrix.shape[-2:]) != [3, 3]:
        raise ValueError(f"matrix: expected shape (..., 3, 3), got {list(matrix.shape)}.")
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    # Row i of 4 q q' is 4 q_i q. Each row gives q; the row with the largest q_i is the most precise.
    rows = (
        [1.0 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01]
        + [m21 - m12, 1.0 + m00 - m11 - m22, m10 + m01, m02 + m20]
        + [m02 - m20, m10 + m01, 1.0 - m00 + m11 - m22, m12 + m21]
        + [m10 - m01, m02 + m20, m12 + m21, 1.0 - m00 - m11 + m22]
    )
    products = torch.stack(rows, dim=-1).unflatten(-1, (4, 4))
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    index = largest[..., None, None].expand_as(products[..., :1, :])
    return normalize(products.gather(-2, index).squeeze(-2))


def quat_from_euler_xyz(roll: torch.Tensor, pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Return the quaternions (..., 4) of Rz(yaw) Ry(pitch) Rx(roll); angles (...) in rad."""
    half = 0.5 * torch.stack(torch.broadcast_tensors(roll, pitch, yaw))
    cr, cp, cy = torch.cos(half).unbind()
    sr, sp, sy = torch.sin(half).unbind()
    # Products of yaw and pitch.
    cc, cs, sc, ss = cy * cp, cy * sp, sy * cp, sy * sp
    return torch.stack(
        (cc * cr + ss * sr, cc * sr - ss * cr, cs * cr + sc * sr, sc * cr - cs * sr), dim=-1
    )


def euler_xyz_from_quat(
    quat: torch.Tensor, wrap_to_2pi: bool = False
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return roll, pitch and yaw (...) in rad, with R(quat) = Rz(yaw) Ry(pitch) Rx(roll).

    Angles are in (-pi, pi], the pitch in [-pi/2, pi/2]; `wrap_to_2pi` gives [0, 2 pi).
    """
    w, x, y, z = quat.unbind(-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if wrap_to_2pi:
        turn = 2.0 * torch.pi
        return roll.remainder(turn), pitch.remainder(turn), yaw.remainder(turn)
    return roll, pitch, yaw


def matrix_from_euler(euler_angles: torch.Tensor, convention: str) -> torch.Tensor:
    """Return the matrices (..., 3, 3) of intrinsic rotations (about the rotated axes).

    Args:
        euler_angles: Angles (rad), (..., 3).
        convention: Three letters of X, Y and Z, adjacent letters different: "XYZ" is Rx Ry Rz.

    Raises `ValueError` for an invalid convention or a wrong last size.
    """
    if euler_angles.shape[-1] != 3:
        raise ValueError(f"euler_angles: expected shape (..., 3), got {list(euler_angles.shape)}.")
    is_valid = len(convention) == 3
    for letter in convention:
        is_valid = is_valid and letter in "XYZ"
    if not is_valid or convention[1] == convention[0] or convention[1] == convention[2]:
        raise ValueError(
            "convention: expected three letters of X, Y and Z, adjacent letters different, such as "
            f"'XYZ' or 'ZXZ', got '{convention}'."
        )
    angles = euler_angles.unbind(-1)
    product = _axis_rotation(convention[0], angles[0])
    for k in range(1, 3):
        product = matrix_product(product, _axis_rotation(convention[k], angles[k]))
    return product


def _axis_rotation(axis: str, angle: torch.Tensor) -> torch.Tensor:
    c, s = torch.cos(angle), torch.sin(angle)
    one, zero = torch.ones_like(angle), torch.zeros_like(angle)
    if axis == "X":
        entries = (one, zero, zero, zero, c, -s, zero, s, c)
    elif axis == "Y":
        entries = (c, zero, s, zero, one, zero, -s, zero, c)
    else:
        entries = (c, -s, zero, s, c, zero, zero, zero, one)
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def convert_camera_frame_orientation_convention(
    orientation: torch.Tensor,
    origin: Literal["opengl", "ros", "world"] = "opengl",
    target: Literal["opengl", "ros", "world"] = "ros",
) -> torch.Tensor:
    """Convert a camera orientation (..., 4) between conventions of camera axes.

    "opengl" looks along -z with +y up, "ros" along +z with -y up, "world" along +x with +z up.
    Unknown conventions are taken as "opengl" with a warning, as in mjlab 1.6.
    """
    if origin == target:
        return orientation.clone()
    for name in (origin, target):
        if name not in _IN_OPENGL:
            warnings.warn(
                f"Camera convention: expected one of {list(_IN_OPENGL)}, got {name!r}; 'opengl' "
                "is used.",
                UserWarning,
                stacklevel=2,
            )
    # Table rows are rows of matrices from coordinates of a convention to OpenGL coordinates.
    opengl = _IN_OPENGL["opengl"]
    from_origin = orientation.new_tensor(_IN_OPENGL.get(origin, opengl))
    from_target = orientation.new_tensor(_IN_OPENGL.get(target, opengl))
    turned = matrix_product(matrix_from_quat(orientation), from_origin.T)
    return quat_from_matrix(matrix_product(turned, from_target))


def create_rotation_matrix_from_view(
    eyes: torch.Tensor,
    targets: torch.Tensor,
    up_axis: Literal["Y", "Z"] = "Z",
    device: str = "cpu",
) -> torch.Tensor:
    """Return orientations (N, 3, 3) of cameras (OpenGL convention) at `eyes` looking at `targets`.

    Args:
        eyes: Camera positions, (N, 3).
        targets: Target positions, (N, 3).
        up_axis: World axis that points up in the image.
        device: Device of the result.

    Cameras that look straight up or down use the world's x axis as right. Raises `ValueError` for an
    unknown `up_axis`.
    """
    check_one_of("up_axis", up_axis, ("Y", "Z"))
    backward = normalize((eyes - targets).to(device))
    up = torch.zeros_like(backward)
    up[..., "XYZ".index(up_axis)] = 1.0
    right = torch.linalg.cross(up, backward)
    is_vertical = torch.linalg.vector_norm(right, dim=-1, keepdim=True) < 1e-5
    right = normalize(torch.where(is_vertical, right.new_tensor((1.0, 0.0, 0.0)), right))
    return torch.stack((right, torch.linalg.cross(backward, right), backward), dim=-1)


# Poses as position (..., 3) and orientation (..., 4).


def combine_frame_transforms(
    t01: torch.Tensor,
    q01: torch.Tensor,
    t12: torch.Tensor | None = None,
    q12: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose of 2 in 0, from poses of 1 in 0 and 2 in 1. None: zero or identity."""
    t02 = t01 if t12 is None else t01 + quat_apply(q01, t12)
    q02 = q01 if q12 is None else quat_mul(q01, q12)
    return t02, q02


def subtract_frame_transforms(
    t01: torch.Tensor,
    q01: torch.Tensor,
    t02: torch.Tensor | None = None,
    q02: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose of 2 in 1, from poses of 1 and 2 in 0. None: zero or identity."""
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
    """Return the error from pose 1 to pose 2: t02 - t01 and the rotation q02 * q01^-1.

    The rotation is in world axes, as a rotation vector (..., 3) or a quaternion ("quat"). Raises
    `ValueError` for an unknown `rot_error_type`.
    """
    check_one_of("rot_error_type", rot_error_type, ("quat", "axis_angle"))
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
    """Return the pose moved by `delta_pose` (..., 6): translation, rotation vector (world axes).

    Rotations by an angle of at most `eps` leave the orientation unchanged.
    """
    return source_pos + delta_pose[..., :3], quat_box_plus(source_rot, delta_pose[..., 3:6], eps)


def rigid_body_twist_transform(
    v0: torch.Tensor, w0: torch.Tensor, t01: torch.Tensor, q01: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return linear and angular velocity of a rigid body in another body-fixed frame.

    Args:
        v0: Linear velocity of the origin of frame 0, in frame 0.
        w0: Angular velocity, in frame 0.
        t01: Position of frame 1 in frame 0.
        q01: Orientation of frame 1 in frame 0.

    Returns both velocities for the origin of frame 1, in frame 1.
    """
    v1 = quat_apply_inverse(q01, v0 + torch.linalg.cross(w0, t01))
    return v1, quat_apply_inverse(q01, w0)


def transform_points(
    points: torch.Tensor, pos: torch.Tensor | None = None, quat: torch.Tensor | None = None
) -> torch.Tensor:
    """Transform points from a frame to its parent frame: R(quat) point + pos.

    Args:
        points: Points, (P, 3) or (N, P, 3).
        pos: Position of the frame, (3,) or (N, 3). None: zero.
        quat: Orientation of the frame, (4,) or (N, 4). None: identity.

    Returns (P, 3), or (N, P, 3) if any argument has N.
    """
    if quat is not None:
        if quat.dim() == 2:
            quat = quat.unsqueeze(-2)
            points = points if points.dim() == 3 else points.unsqueeze(0)
        else:
            quat = quat.reshape([1] * (points.dim() - 1) + [4])
        points = _rotate(quat, points, sign=1)
    if pos is not None:
        points = points + (pos.unsqueeze(-2) if pos.dim() == 2 else pos)
    return points


def is_identity_pose(pos: torch.Tensor, rot: torch.Tensor) -> bool:
    """Return True if all poses, (..., 3) and (..., 4), are (nearly) the identity."""
    no_shift = torch.allclose(pos, torch.zeros_like(pos))
    # q and -q are the same rotation.
    identity = torch.zeros_like(rot)
    identity[..., 0] = 1.0
    sign = torch.where(rot[..., :1] < 0, -1.0, 1.0)
    return no_shift and torch.allclose(rot * sign, identity)


# Poses as homogeneous matrices (..., 4, 4).


def make_pose(pos: torch.Tensor, rot: torch.Tensor) -> torch.Tensor:
    """Return poses (..., 4, 4) from positions (..., 3) and rotation matrices (..., 3, 3).

    Raises `ValueError` if the leading sizes differ.
    """
    sizes = list(pos.shape[:-1])
    if pos.shape[-1] != 3 or list(rot.shape) != sizes + [3, 3]:
        raise ValueError(
            "make_pose: expected positions (..., 3) and rotations (..., 3, 3) with equal leading "
            f"sizes, got {list(pos.shape)} and {list(rot.shape)}."
        )
    pose = torch.zeros(sizes + [4, 4], dtype=pos.dtype, device=pos.device)
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
    """Transform a pose from frame A to frame B, given the pose of A in B."""
    return matrix_product(pose_A_in_B, pose_in_A)


def transform_poses_from_frame_A_to_frame_B(
    src_poses: torch.Tensor, frame_A: torch.Tensor, frame_B: torch.Tensor
) -> torch.Tensor:
    """Return poses that have the same pose relative to frame B as `src_poses` relative to frame A.

    Args:
        src_poses: Poses in the world, (N, 4, 4).
        frame_A: Pose of A in the world, (4, 4).
        frame_B: Pose of B in the world, (4, 4).
    """
    return matrix_product(frame_B, matrix_product(pose_inv(frame_A), src_poses))


def interpolate_rotations(
    R1: torch.Tensor, R2: torch.Tensor, num_steps: int, axis_angle: bool = True
) -> torch.Tensor:
    """Interpolate rotation matrices from R1 to R2 in equal steps, (num_steps + 1, 3, 3).

    Args:
        R1: First matrix, (3, 3).
        R2: Last matrix, (3, 3).
        num_steps: Number of steps.
        axis_angle: Rotate about a fixed axis. False: interpolate quaternions (same path).

    Raises `ValueError` if `num_steps` < 1.
    """
    if num_steps < 1:
        raise ValueError(f"num_steps: expected an integer >= 1, got {num_steps}.")
    fractions = [step / num_steps for step in range(num_steps)]
    if axis_angle:
        vector = axis_angle_from_quat(quat_from_matrix(matrix_product(R2, R1.transpose(-1, -2))))
        angle = torch.linalg.vector_norm(vector) * torch.tensor(
            fractions, dtype=R1.dtype, device=R1.device
        )
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
    """Return both poses with interpolated poses in between, and the number of poses in between.

    Args:
        pose_1: First pose, (4, 4).
        pose_2: Last pose, (4, 4).
        num_steps: Number of poses in between.
        step_size: Maximum distance (m) between positions, as an alternative to `num_steps`.
        perturb: Shift interpolated positions randomly along the path, by up to half a step.

    Returns (number in between + 2, 4, 4) and the number in between. Raises `ValueError` unless
    exactly one of `num_steps` and `step_size` is not None.
    """
    if (num_steps is None) == (step_size is None):
        raise ValueError(f"Expected either num_steps or step_size, got {num_steps}, {step_size}.")
    pos_1, rot_1 = unmake_pose(pose_1)
    pos_2, rot_2 = unmake_pose(pose_2)
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
    """Return a random pose (4, 4): see `generate_random_rotation` and `generate_random_translation`."""
    return make_pose(
        generate_random_translation(pos_boundary), generate_random_rotation(rot_boundary)
    )


# Scalars and vectors.


def scale_transform(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Map [lower, upper] linearly to [-1, 1]."""
    return 2.0 * (x - 0.5 * (lower + upper)) / (upper - lower)


def unscale_transform(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Map [-1, 1] linearly to [lower, upper]."""
    return 0.5 * x * (upper - lower) + 0.5 * (lower + upper)


def saturate(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Clamp `x` to [lower, upper], element-wise."""
    return torch.maximum(torch.minimum(x, upper), lower)


def normalize(x: torch.Tensor, eps: float = 1e-9) -> torch.Tensor:
    """Normalize vectors along the last axis. Vectors shorter than `eps` are divided by `eps`."""
    return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp(min=eps)


def wrap_to_pi(angles: torch.Tensor) -> torch.Tensor:
    """Wrap angles (rad) to [-pi, pi]. Odd multiples of pi keep their sign."""
    turned = torch.remainder(angles + torch.pi, 2.0 * torch.pi)
    return torch.where((turned == 0) & (angles > 0), torch.pi, turned - torch.pi)


def copysign(mag: float, other: torch.Tensor) -> torch.Tensor:
    """Return numbers of magnitude `mag` with the signs of `other`."""
    return torch.copysign(torch.full_like(other, abs(mag)), other)


def matrix_product(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return the products (..., i, k) of small matrices (..., i, j) and (..., j, k).

    Computed as sums, because GPUs may round the operands of `@` to TF32: an error of 8 mm at 10 m.
    """
    return (first.unsqueeze(-1) * second.unsqueeze(-3)).sum(dim=-2)


def skew_symmetric_matrix(vec: torch.Tensor) -> torch.Tensor:
    """Return the skew-symmetric matrices S with S u = vec x u, (..., 3, 3); (1, 3, 3) of a (3,)."""
    x, y, z = torch.atleast_2d(vec).unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


# Samples.


def sample_uniform(
    lower: torch.Tensor | float, upper: torch.Tensor | float, size: Size, device: str
) -> torch.Tensor:
    """Sample uniformly in [lower, upper). The bounds may be tensors that broadcast."""
    return torch.rand(_shape(size), dtype=torch.float32, device=device) * (upper - lower) + lower


def sample_ranges(ranges: Iterable[tuple[float, float]], size: Size, device: str) -> torch.Tensor:
    """Sample (*size, n), with column i uniform in the i-th of n ranges [low, high)."""
    low, high = (
        constant_tensor(tuple(map(float, side)), device) for side in zip(*ranges, strict=True)
    )
    return sample_uniform(low, high, (*_shape(size), len(low)), device)


def sample_log_uniform(
    lower: torch.Tensor | float, upper: torch.Tensor | float, size: Size, device: str
) -> torch.Tensor:
    """Sample log-uniformly between positive bounds."""
    low = torch.as_tensor(lower, dtype=torch.float32, device=device).log()
    high = torch.as_tensor(upper, dtype=torch.float32, device=device).log()
    return torch.exp(sample_uniform(low, high, size, device))


def sample_gaussian(
    mean: torch.Tensor | float, std: torch.Tensor | float, size: Size, device: str
) -> torch.Tensor:
    """Sample a normal distribution.

    If `mean` is a tensor, the result has its shape, and `size` is not used.
    """
    shape = mean.shape if isinstance(mean, torch.Tensor) else _shape(size)
    return torch.randn(shape, dtype=torch.float32, device=device) * std + mean


def sample_triangle(lower: float, upper: float, size: Size, device: str) -> torch.Tensor:
    """Sample the symmetric triangular distribution on [lower, upper]."""
    # The mean of two uniform numbers has this distribution.
    mean = 0.5 * (
        torch.rand(_shape(size), dtype=torch.float32, device=device)
        + torch.rand(_shape(size), dtype=torch.float32, device=device)
    )
    return mean * (upper - lower) + lower


def sample_cylinder(
    radius: float, h_range: tuple[float, float], size: Size, device: str
) -> torch.Tensor:
    """Sample points (*size, 3) uniformly on the side of a cylinder about z, with z in `h_range`."""
    angle = sample_uniform(-torch.pi, torch.pi, size, device)
    height = sample_uniform(h_range[0], h_range[1], size, device)
    return torch.stack((radius * torch.cos(angle), radius * torch.sin(angle), height), dim=-1)


def default_orientation(num: int, device: str) -> torch.Tensor:
    """Return identity quaternions (num, 4)."""
    quat = torch.zeros(num, 4, dtype=torch.float32, device=device)
    quat[:, 0] = 1.0
    return quat


def random_orientation(num: int, device: str) -> torch.Tensor:
    """Sample quaternions (num, 4) uniformly over all orientations."""
    # The direction of a normally distributed vector is uniform on the sphere.
    return normalize(torch.randn(num, 4, dtype=torch.float32, device=device))


def random_yaw_orientation(num: int, device: str) -> torch.Tensor:
    """Sample quaternions (num, 4) of rotations about z with uniform angle."""
    zero = torch.zeros(num, dtype=torch.float32, device=device)
    yaw = torch.rand(num, dtype=torch.float32, device=device) * (2.0 * torch.pi)
    return quat_from_euler_xyz(zero, zero, yaw)


def _shape(size: Size) -> tuple[int, ...]:
    return (size,) if isinstance(size, int) else tuple(size)


# Pinhole cameras.


def project_points(points: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Return pixel coordinates and depth (u, v, z) of points.

    Args:
        points: Points in the camera frame, (P, 3) or (N, P, 3).
        intrinsics: K, (3, 3) or (N, 3, 3).

    Returns:
        (N, P, 3), with N = 1 if neither argument has a batch dimension.

    Raises:
        ValueError: `points` has a wrong number of dimensions.
    """
    if points.ndim not in (2, 3):
        raise ValueError(f"points: expected (P, 3) or (N, P, 3), got {list(points.shape)}.")
    # Not a matrix product, because GPUs may compute it in TF32.
    scaled = (intrinsics.unsqueeze(-3) * points.unsqueeze(-2)).sum(-1)
    scaled = scaled if scaled.ndim == 3 else scaled.unsqueeze(0)
    return torch.cat((scaled[..., :2] / scaled[..., 2:], scaled[..., 2:]), dim=-1)


def unproject_depth(
    depth: torch.Tensor, intrinsics: torch.Tensor, is_ortho: bool = True
) -> torch.Tensor:
    """Return the points of a depth image in the camera frame, column by column of the image.

    Args:
        depth: Image, (H, W), (H, W, 1), (N, H, W) or (N, H, W, 1).
        intrinsics: K, (3, 3) or (N, 3, 3).
        is_ortho: True for depths along the camera's z axis, False for distances from the camera.

    Returns:
        (W H, 3), or (N, W H, 3) if the image or K has a batch dimension. Point u H + v belongs to
        pixel (u, v).

    Raises:
        ValueError: `depth` has a wrong number of dimensions.
    """
    if not is_ortho:
        depth = orthogonalize_perspective_depth(depth, intrinsics)
    image = _without_channel(depth)
    rays = _rays(image, intrinsics)
    return (image.unsqueeze(-1) * rays).transpose(-3, -2).flatten(-3, -2)


def orthogonalize_perspective_depth(depth: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Convert distances to the camera to depths along the camera's z axis.

    Args:
        depth: Image, (H, W), (H, W, 1), (N, H, W) or (N, H, W, 1).
        intrinsics: K, (3, 3) or (N, 3, 3).

    Returns:
        The shape of `depth`, with a leading N if only K has a batch dimension.

    Raises:
        ValueError: `depth` has a wrong number of dimensions.
    """
    image = _without_channel(depth)
    result = image / torch.linalg.vector_norm(_rays(image, intrinsics), dim=-1)
    return result if image is depth else result.unsqueeze(-1)


def _without_channel(depth: torch.Tensor) -> torch.Tensor:
    if depth.ndim not in (2, 3, 4) or (depth.ndim == 4 and depth.shape[-1] != 1):
        raise ValueError(
            "depth: expected (H, W), (H, W, 1), (N, H, W) or (N, H, W, 1), "
            f"got {list(depth.shape)}."
        )
    has_channel = depth.ndim == 4 or (depth.ndim == 3 and depth.shape[-1] == 1)
    return depth.squeeze(-1) if has_channel else depth


def _rays(image: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Return K^-1 (u, v, 1) of all pixels, (H, W, 3) or (N, H, W, 3)."""
    height, width = image.shape[-2:]
    v, u = torch.meshgrid(
        torch.arange(height, device=image.device, dtype=image.dtype),
        torch.arange(width, device=image.device, dtype=image.dtype),
        indexing="ij",
    )
    k = intrinsics[..., None, None]  # (..., 3, 3, 1, 1)
    y = (v - k[..., 1, 2, :, :]) / k[..., 1, 1, :, :]
    x = (u - k[..., 0, 2, :, :] - k[..., 0, 1, :, :] * y) / k[..., 0, 0, :, :]
    return torch.stack((x, y, torch.ones_like(x)), dim=-1)
