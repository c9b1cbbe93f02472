"""What an entity's spec is made of: which joints it has, and where its root is."""

from __future__ import annotations

import mujoco

_FREE = mujoco.mjtJoint.mjJNT_FREE
_BALL = mujoco.mjtJoint.mjJNT_BALL


def find_joints(
    spec: mujoco.MjSpec,
) -> tuple[mujoco.MjsJoint | None, tuple[mujoco.MjsJoint, ...]]:
    """Return the free joint of `spec`, if any, and the others. An unnamed free joint is named.

    Raises:
        ValueError: there are several free joints, one that is not the first joint, or ball joints.
    """
    joints = tuple(spec.joints)
    free = [joint for joint in joints if joint.type == _FREE]
    if len(free) > 1:
        raise ValueError(
            f"The spec {spec.modelname!r} has {len(free)} free joints, of the bodies "
            f"{[joint.parent.name for joint in free]}; an entity may have one. Make each "
            "floating body an entity of its own."
        )
    if free and joints[0] is not free[0]:
        raise ValueError(
            f"The free joint of body {free[0].parent.name!r} comes after the joint "
            f"{joints[0].name!r} of body {joints[0].parent.name!r}. The free joint must be the "
            "first joint of an entity: put its body first, or make it an entity of its own."
        )
    balls = [joint.name or f"(unnamed, of {joint.parent.name!r})" for joint in joints
             if joint.type == _BALL]  # fmt: skip
    if balls:
        raise ValueError(
            f"The spec {spec.modelname!r} has ball joints: {balls}. An entity's joints have one "
            "position each; use three hinges instead."
        )
    if free and not free[0].name:
        free[0].name = "floating_base_joint"
    return (free[0] if free else None), tuple(joint for joint in joints if joint.type != _FREE)


def place_body(body: mujoco.MjsBody, pose: tuple[float, ...]) -> None:
    """Set where a body is in its parent: position, quaternion (w, x, y, z)."""
    body.pos[:] = pose[:3]
    # An orientation written in another form would win over the quaternion.
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.quat[:] = pose[3:7]
