"""Conversions between quaternions (w, x, y, z), matrices and Euler angles."""

from __future__ import annotations

from typing import Any, Literal, TypeVar

import numpy as np
import torch

from mjlab.utils.lab_api._basics import matrix_product, normalize

ArrayT = TypeVar("ArrayT", torch.Tensor, np.ndarray)

# A camera's axes (columns) in those of the OpenGL convention: there it looks along -z with +y up.
_IN_OPENGL = {
    "opengl": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    # Looks along +z, up is -y.
    "ros": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    # Looks along +x, up is +z.
    "world": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
}


def convert_quat(quat: ArrayT, to: Literal["xyzw", "wxyz"] = "xyzw") -> ArrayT:
    """Reorder quaternions (..., 4) from (w, x, y, z) to (x, y, z, w), or back.

    Raises `ValueError` for another target or last size.
    """
    if to not in ("xyzw", "wxyz"):
        raise ValueError(f"to={to!r}; it must be 'xyzw' or 'wxyz'.")
    if quat.shape[-1] != 4:
        raise ValueError(f"Expected quaternions of shape (..., 4), got {tuple(quat.shape)}.")
    shift = -1 if to == "xyzw" else 1
    roll: Any = torch.roll if isinstance(quat, torch.Tensor) else np.roll
    return roll(quat, shift, -1)


def matrix_from_quat(quaternions: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) of quaternions of any norm but zero."""
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

    The component of largest magnitude is positive (so w can be negative). Raises `ValueError` for
    another shape.
    """
    if matrix.shape[-2:] != (3, 3):
        raise ValueError(f"Expected matrices of shape (..., 3, 3), got {tuple(matrix.shape)}.")
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    # Row i of 4 q q' is 4 q_i q: any of them gives q, the one with the largest q_i most precisely.
    products = torch.stack(
        (
            *(1.0 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01),
            *(m21 - m12, 1.0 + m00 - m11 - m22, m10 + m01, m02 + m20),
            *(m02 - m20, m10 + m01, 1.0 - m00 + m11 - m22, m12 + m21),
            *(m10 - m01, m02 + m20, m12 + m21, 1.0 - m00 - m11 + m22),
        ),
        dim=-1,
    ).unflatten(-1, (4, 4))
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    return normalize(products.gather(-2, index).squeeze(-2))


def quat_from_euler_xyz(roll: torch.Tensor, pitch: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
    """Return the quaternions (..., 4) of Rz(yaw) Ry(pitch) Rx(roll); angles (...) in rad."""
    half = 0.5 * torch.stack(torch.broadcast_tensors(roll, pitch, yaw))
    cr, cp, cy = torch.cos(half)
    sr, sp, sy = torch.sin(half)
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
    """Return the matrices (..., 3, 3) of rotations about the body's own axes, one after another.

    Args:
        euler_angles: (..., 3), rad.
        convention: Three letters of X, Y and Z, neighbours different: "XYZ" is Rx Ry Rz.

    Raises `ValueError` for another convention or last size.
    """
    if euler_angles.shape[-1] != 3:
        raise ValueError(f"Expected angles of shape (..., 3), got {tuple(euler_angles.shape)}.")
    is_valid = len(convention) == 3 and set(convention) <= set("XYZ")
    if not is_valid or convention[1] in (convention[0], convention[2]):
        raise ValueError(
            f"The convention is {convention!r}; it must be three letters of X, Y and Z, no letter "
            "twice in a row, as 'XYZ' or 'ZXZ'."
        )
    first, second, third = (
        _axis_rotation(axis, angle)
        for axis, angle in zip(convention, euler_angles.unbind(-1), strict=True)
    )
    return matrix_product(matrix_product(first, second), third)


def _axis_rotation(axis: str, angle: torch.Tensor) -> torch.Tensor:
    c, s = torch.cos(angle), torch.sin(angle)
    one, zero = torch.ones_like(angle), torch.zeros_like(angle)
    entries = {
        "X": (one, zero, zero, zero, c, -s, zero, s, c),
        "Y": (c, zero, s, zero, one, zero, -s, zero, c),
        "Z": (c, -s, zero, s, c, zero, zero, zero, one),
    }[axis]
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def convert_camera_frame_orientation_convention(
    orientation: torch.Tensor,
    origin: Literal["opengl", "ros", "world"] = "opengl",
    target: Literal["opengl", "ros", "world"] = "ros",
) -> torch.Tensor:
    """Return the orientation (..., 4) of the same camera in another convention for its axes.

    "opengl" looks along -z with +y up, "ros" along +z with -y up, "world" along +x with +z up.
    Raises `ValueError` for another convention.
    """
    for name in (origin, target):
        if name not in _IN_OPENGL:
            raise ValueError(f"Unknown convention {name!r}; use one of {list(_IN_OPENGL)}.")
    if origin == target:
        return orientation.clone()
    # Rows of the table are rows of matrices that take coordinates of a convention to OpenGL's.
    from_origin = orientation.new_tensor(_IN_OPENGL[origin])
    from_target = orientation.new_tensor(_IN_OPENGL[target])
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
        eyes: (N, 3).
        targets: (N, 3).
        up_axis: The axis of the world that points up in the image.
        device: Where the result lies.

    A camera that looks straight up or down takes the world's x axis as its right. Raises
    `ValueError` for another `up_axis`.
    """
    if up_axis not in ("Y", "Z"):
        raise ValueError(f"up_axis is {up_axis!r}; it must be 'Y' or 'Z'.")
    backward = normalize((eyes - targets).to(device))
    up = torch.zeros_like(backward)
    up[..., "XYZ".index(up_axis)] = 1.0
    right = torch.linalg.cross(up, backward)
    is_vertical = torch.linalg.vector_norm(right, dim=-1, keepdim=True) < 1e-5
    right = normalize(torch.where(is_vertical, right.new_tensor((1.0, 0.0, 0.0)), right))
    return torch.stack((right, torch.linalg.cross(backward, right), backward), dim=-1)
