"""Quaternions (w, x, y, z) with the Hamilton product, on the last axis of a tensor."""

from __future__ import annotations

import torch

from mjlab.utils.lab_api._basics import normalize


def quat_mul(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return q1 * q2: rotate by q2, then by q1. `ValueError` unless the shapes are equal."""
    if q1.shape != q2.shape:
        raise ValueError(
            f"quat_mul got shapes {tuple(q1.shape)} and {tuple(q2.shape)}; they must be equal "
            "(expand one of them)."
        )
    # Each component of q1 times all of q2: 16 operations, where the components of the product, one
    # by one, take 29.
    product = q1[..., :1] * q2
    w, x, y, z = (product[..., k] for k in range(4))
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
        quat: Unit quaternions, one for each vector or one for all; (..., 4).
        vec: (..., 3).

    Returns a tensor of the shape of `vec`. Raises `ValueError` if sizes do not fit.
    """
    return _rotate(_fit_to(quat, vec), vec, sign=1.0)


def quat_apply_inverse(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors back: R(q)' v. Arguments and errors are those of `quat_apply`."""
    return _rotate(_fit_to(quat, vec), vec, sign=-1.0)


quat_rotate = quat_apply
quat_rotate_inverse = quat_apply_inverse


def quat_apply_yaw(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Rotate vectors by the yaw of the quaternions only."""
    return quat_apply(yaw_quat(quat), vec)


def yaw_quat(quat: torch.Tensor) -> torch.Tensor:
    """Return the rotation about z by the yaw angle of the quaternions; (..., 4)."""
    w, x, y, z = quat.unbind(-1)
    half = 0.5 * torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    zero = torch.zeros_like(half)
    return torch.stack((torch.cos(half), zero, zero, torch.sin(half)), dim=-1)


def quat_from_angle_axis(angle: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return the rotation by `angle` (...) rad about `axis` (..., 3), normalized here."""
    half = 0.5 * angle.unsqueeze(-1)
    direction = normalize(axis)
    vector = direction * torch.sin(half)
    # Normalized again for the sake of axes of length zero.
    return normalize(torch.cat((torch.cos(half).expand_as(vector[..., :1]), vector), dim=-1))


def axis_angle_from_quat(quat: torch.Tensor, eps: float = 1.0e-6) -> torch.Tensor:
    """Return the rotation vector, axis times angle in [0, pi]; (..., 3).

    Half angles with a sine of at most `eps` use the series of angle / sin(angle / 2).
    """
    quat = quat_unique(quat)
    real, vector = quat[..., :1], quat[..., 1:]
    sine = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, real)
    is_small = sine <= eps
    # A divisor of 1 where the series is used keeps gradients finite.
    ratio = angle / torch.where(is_small, 1.0, sine)
    return vector * torch.where(is_small, 2.0 + angle.square() / 12.0, ratio)


def quat_box_minus(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return log(q1 * conj(q2)): the rotation vector, in world axes, that takes q2 to q1."""
    return axis_angle_from_quat(quat_mul(q1, quat_conjugate(q2)))


def quat_box_plus(q: torch.Tensor, delta: torch.Tensor, eps: float = 1.0e-6) -> torch.Tensor:
    """Return exp(delta) * q: q rotated by the rotation vector `delta` (..., 3) in world axes.

    Rotations by an angle of at most `eps` leave q unchanged.
    """
    angle = torch.linalg.vector_norm(delta, dim=-1)
    turned = quat_mul(quat_from_angle_axis(angle, delta), q)
    return torch.where(angle.unsqueeze(-1) > eps, turned, q)


def quat_error_magnitude(q1: torch.Tensor, q2: torch.Tensor) -> torch.Tensor:
    """Return the angle between two orientations, unit quaternions, in [0, pi]; (...)."""
    # Chords of the unit sphere are cheap, and precise for small angles: |q1 - q2| = 2 sin(angle / 4)
    # and |q1 + q2| = 2 cos(angle / 4), or the other way round where one of them is to be negated.
    away = torch.linalg.vector_norm(q1 - q2, dim=-1)
    along = torch.linalg.vector_norm(q1 + q2, dim=-1)
    return 4.0 * torch.atan2(torch.minimum(away, along), torch.maximum(away, along))


def quat_slerp(q1: torch.Tensor, q2: torch.Tensor, tau: float) -> torch.Tensor:
    """Interpolate the short way between two quaternions, (4,) each; tau 0 gives q1, 1 gives q2.

    (Nearly) equal rotations give q1. The arguments are not changed. Raises `ValueError` for
    other shapes.
    """
    if q1.shape != (4,) or q2.shape != (4,):
        raise ValueError(
            f"quat_slerp takes two quaternions of shape (4,), got {tuple(q1.shape)} and "
            f"{tuple(q2.shape)}."
        )
    if tau == 0.0:
        return q1.clone()
    if tau == 1.0:
        return q2.clone()
    target = torch.where(torch.dot(q1, q2) < 0, -q2, q2)
    # Precise for small angles too, where the arc cosine is not.
    angle = 2.0 * torch.atan2((q1 - target).norm(), (q1 + target).norm())
    sine = torch.sin(angle)
    if sine <= 4.0 * torch.finfo(q1.dtype).eps:
        return q1.clone()
    return (torch.sin((1.0 - tau) * angle) * q1 + torch.sin(tau * angle) * target) / sine


def _rotate(quat: torch.Tensor, vec: torch.Tensor, sign: float) -> torch.Tensor:
    """Return v + 2 (s w c + xyz x c) with c = xyz x v; `sign` s is -1 for the inverse rotation."""
    w, xyz = quat[..., :1], quat[..., 1:]
    cross = torch.linalg.cross(xyz, vec)
    change = torch.linalg.cross(xyz, cross).addcmul_(w, cross, value=sign)
    return torch.add(vec, change, alpha=2.0)


def _fit_to(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Return `quat` in a shape whose leading sizes broadcast to those of `vec`."""
    if quat.shape[-1] == 4 and vec.shape[-1] == 3:
        if quat.shape[:-1] == vec.shape[:-1]:
            return quat
        num_quats = quat.numel() // 4
        if num_quats == 1:
            return quat.reshape(*(1,) * (vec.dim() - 1), 4)
        if num_quats == vec.numel() // 3:
            return quat.reshape(*vec.shape[:-1], 4)
        if quat.dim() == vec.dim() and all(
            size in (1, wanted) for size, wanted in zip(quat.shape[:-1], vec.shape, strict=False)
        ):
            return quat
    raise ValueError(
        f"Cannot rotate vectors of shape {tuple(vec.shape)} by quaternions of shape "
        f"{tuple(quat.shape)}; expected (..., 3) and (..., 4), one quaternion for each vector or "
        "one for all."
    )
