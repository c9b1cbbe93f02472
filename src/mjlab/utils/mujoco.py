"""Facts about elements of a MuJoCo spec: widths of joints, kinds of actuators."""

from __future__ import annotations

from typing import Literal

import mujoco

CommandField = Literal["position", "velocity", "effort"]

_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE

# Number of entries in qpos and in qvel.
_WIDTHS = {
    int(_FREE): (7, 6),
    int(_BALL): (4, 3),
    int(_SLIDE): (1, 1),
    int(_HINGE): (1, 1),
}


def qpos_width(joint_type: int | mujoco.mjtJoint) -> int:
    """Return how many entries of `qpos` a joint of this type has. `ValueError` if unknown."""
    return _width(joint_type)[0]


def dof_width(joint_type: int | mujoco.mjtJoint) -> int:
    """Return how many entries of `qvel` a joint of this type has. `ValueError` if unknown."""
    return _width(joint_type)[1]


def _width(joint_type: int | mujoco.mjtJoint) -> tuple[int, int]:
    try:
        return _WIDTHS[int(joint_type)]
    except KeyError:
        raise ValueError(
            f"{joint_type!r} is no joint type; use a member of mujoco.mjtJoint "
            "(mjJNT_FREE, mjJNT_BALL, mjJNT_SLIDE or mjJNT_HINGE)."
        ) from None


def is_muscle_actuator(actuator: mujoco.MjsActuator) -> bool:
    """Return whether the actuator has muscle activation dynamics."""
    return actuator.dyntype == mujoco.mjtDyn.mjDYN_MUSCLE


def is_position_actuator(actuator: mujoco.MjsActuator) -> bool:
    """Return whether the actuator is a position servo: force = kp (u - l) - kd l'."""
    unfiltered = actuator.dyntype in (
        mujoco.mjtDyn.mjDYN_NONE,
        mujoco.mjtDyn.mjDYN_FILTEREXACT,
    )
    return unfiltered and _has_affine_bias(actuator) and actuator.gainprm[0] == -actuator.biasprm[1]


def is_velocity_actuator(actuator: mujoco.MjsActuator) -> bool:
    """Return whether the actuator is a velocity servo: force = kd (u - l')."""
    return (
        actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE
        and _has_affine_bias(actuator)
        and actuator.biasprm[1] == 0.0
        and actuator.gainprm[0] == -actuator.biasprm[2]
    )


def is_motor_actuator(actuator: mujoco.MjsActuator) -> bool:
    """Return whether the actuator applies its control as a force: fixed gain and no bias."""
    return (
        actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        and not is_muscle_actuator(actuator)
    )


def detect_command_field(actuator: mujoco.MjsActuator) -> CommandField:
    """Return which command the control of `actuator` is: a position, a velocity or an effort.

    Raises `ValueError` for an actuator that is no motor, muscle, position or velocity servo.
    """
    if is_muscle_actuator(actuator):
        return "effort"
    if is_position_actuator(actuator):
        return "position"
    if is_velocity_actuator(actuator):
        return "velocity"
    if is_motor_actuator(actuator):
        return "effort"
    raise ValueError(
        f"The kind of actuator {actuator.name!r} cannot be detected (dyntype "
        f"{actuator.dyntype.name}, gaintype {actuator.gaintype.name}, biastype "
        f"{actuator.biastype.name}, gainprm {list(actuator.gainprm[:3])}, biasprm "
        f"{list(actuator.biasprm[:3])}). Known are <motor>, <position>, <velocity> and <muscle>; "
        "for another kind state the command field in the actuator config."
    )


def _has_affine_bias(actuator: mujoco.MjsActuator) -> bool:
    return (
        actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    )
