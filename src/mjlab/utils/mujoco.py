"""MuJoCo helpers: joint widths, actuator kinds, enum names, column addresses."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable
from typing import Any, Literal

import mujoco
import numpy as np

from mjlab.utils.errors import check_one_of

CommandField = Literal["position", "velocity", "effort"]

_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE

# Numbers of entries in qpos and qvel.
_WIDTHS = {
    int(_FREE): (7, 6),
    int(_BALL): (4, 3),
    int(_SLIDE): (1, 1),
    int(_HINGE): (1, 1),
}

# In control order. A feedforward input is a force; a voltage is an effort command.
_INPUTS: tuple[tuple[mujoco.mjtCtrlInput, CommandField], ...] = (
    (mujoco.mjtCtrlInput.mjINPUT_POS, "position"),
    (mujoco.mjtCtrlInput.mjINPUT_VEL, "velocity"),
    (mujoco.mjtCtrlInput.mjINPUT_FF, "effort"),
    (mujoco.mjtCtrlInput.mjINPUT_VOLTAGE, "effort"),
)
# Default inputs.
_DEFAULT_INPUTS = {
    int(mujoco.mjtGain.mjGAIN_PID): (
        mujoco.mjtCtrlInput.mjINPUT_POS.value | mujoco.mjtCtrlInput.mjINPUT_VEL.value
    ),
    int(mujoco.mjtGain.mjGAIN_DCMOTOR): mujoco.mjtCtrlInput.mjINPUT_VOLTAGE.value,
}

OBJECT_TYPES = {
    "bodies": mujoco.mjtObj.mjOBJ_BODY,
    "joints": mujoco.mjtObj.mjOBJ_JOINT,
    "geoms": mujoco.mjtObj.mjOBJ_GEOM,
    "sites": mujoco.mjtObj.mjOBJ_SITE,
    "tendons": mujoco.mjtObj.mjOBJ_TENDON,
    "cameras": mujoco.mjtObj.mjOBJ_CAMERA,
    "lights": mujoco.mjtObj.mjOBJ_LIGHT,
    "meshes": mujoco.mjtObj.mjOBJ_MESH,
    "materials": mujoco.mjtObj.mjOBJ_MATERIAL,
    "textures": mujoco.mjtObj.mjOBJ_TEXTURE,
    "pairs": mujoco.mjtObj.mjOBJ_PAIR,
    "actuators": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "equalities": mujoco.mjtObj.mjOBJ_EQUALITY,
    "sensors": mujoco.mjtObj.mjOBJ_SENSOR,
}
"""Type of the elements in each list of `MjSpec`."""

OPTION_ENUMS = {
    "jacobian": (mujoco.mjtJacobian, "mjJAC_"),
    "cone": (mujoco.mjtCone, "mjCONE_"),
    "integrator": (mujoco.mjtIntegrator, "mjINT_"),
    "solver": (mujoco.mjtSolver, "mjSOL_"),
    "disableflags": (mujoco.mjtDisableBit, "mjDSBL_"),
    "enableflags": (mujoco.mjtEnableBit, "mjENBL_"),
}
"""Enum (for flags: bits) and member prefix of options with enum values."""


def enum_value(option: str, name: Any, enum: Any, prefix: str = "") -> int:
    """Return the enum member with a lower-case name.

    Raises:
        ValueError: unknown name. The message lists the valid names and starts with `option`.
    """
    members = _members(enum, prefix)
    check_one_of(option, name, members)
    return members[name]


def enum_bits(option: str, names: Iterable[str], enum: Any, prefix: str = "") -> int:
    """Return the bits of several names; see `enum_value`."""
    return functools.reduce(
        operator.or_, (enum_value(option, name, enum, prefix) for name in names), 0
    )


def flag_names(option: str, bits: int) -> list[str]:
    """Return the lower-case names of the bits set in `disableflags` or `enableflags`."""
    return [name for name, bit in _members(*OPTION_ENUMS[option]).items() if bits & bit]


def qpos_width(joint_type: int | mujoco.mjtJoint) -> int:
    """Return the number of `qpos` entries of a joint type. Raises `ValueError` if unknown."""
    return _width(joint_type)[0]


def dof_width(joint_type: int | mujoco.mjtJoint) -> int:
    """Return the number of `qvel` entries of a joint type. Raises `ValueError` if unknown."""
    return _width(joint_type)[1]


def is_muscle_actuator(actuator: mujoco.MjsActuator) -> bool:
    """Return True if the actuator has muscle activation dynamics."""
    return actuator.dyntype == mujoco.mjtDyn.mjDYN_MUSCLE


def is_position_actuator(actuator: mujoco.MjsActuator) -> bool:
    """Return True for a position servo: force = kp (u - l) - kd l'."""
    unfiltered = actuator.dyntype in (
        mujoco.mjtDyn.mjDYN_NONE,
        mujoco.mjtDyn.mjDYN_FILTEREXACT,
    )
    return unfiltered and _has_affine_bias(actuator) and actuator.gainprm[0] == -actuator.biasprm[1]


def is_velocity_actuator(actuator: mujoco.MjsActuator) -> bool:
    """Return True for a velocity servo: force = kd (u - l')."""
    return (
        actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE
        and _has_affine_bias(actuator)
        and actuator.biasprm[1] == 0.0
        and actuator.gainprm[0] == -actuator.biasprm[2]
    )


def is_motor_actuator(actuator: mujoco.MjsActuator) -> bool:
    """Return True for a motor: force = gain * u, with fixed gain and no bias."""
    return (
        actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        and not is_muscle_actuator(actuator)
    )


def control_inputs(actuator: mujoco.MjsActuator) -> tuple[CommandField | None, ...]:
    """Return the command field of each control of `actuator`, in `ctrl` order.

    None: control of an unknown kind, or a component of an orientation. `<pid>` and `<dcmotor>` have
    one control per input, `<orientation>` three or four.
    """
    if actuator.gaintype == mujoco.mjtGain.mjGAIN_SO3:
        is_quaternion = actuator.ctrlspec == mujoco.mjtCtrlChart.mjCHART_QUAT
        return (None,) * (4 if is_quaternion else 3)
    default = _DEFAULT_INPUTS.get(int(actuator.gaintype))
    if default is not None:
        present = actuator.ctrlspec or default
        return tuple(command for bit, command in _INPUTS if present & int(bit))
    if is_position_actuator(actuator):
        return ("position",)
    if is_velocity_actuator(actuator):
        return ("velocity",)
    if is_muscle_actuator(actuator) or is_motor_actuator(actuator):
        return ("effort",)
    return (None,)


def detect_command_field(actuator: mujoco.MjsActuator) -> CommandField:
    """Return the command field of a single-control actuator: position, velocity or effort.

    Raises `ValueError` for actuators of an unknown kind, without controls or with several controls.
    """
    inputs = control_inputs(actuator)
    if len(inputs) != 1:
        raise ValueError(
            f"Actuator {actuator.name!r}: expected one control, got {len(inputs)}; use "
            "control_inputs."
        )
    if inputs[0] is None:
        raise ValueError(
            f"Actuator {actuator.name!r}: expected <motor>, <position>, <velocity>, <muscle>, <pid> or "
            f"<dcmotor>, got an unknown kind (dyntype {actuator.dyntype.name}, gaintype "
            f"{actuator.gaintype.name}, biastype {actuator.biastype.name}, gainprm "
            f"{list(actuator.gainprm[:3])}, biasprm {list(actuator.biasprm[:3])}); set command_field in "
            "the actuator config."
        )
    return inputs[0]


def moving_dofs(model: mujoco.MjModel) -> np.ndarray:
    """Return True for degrees of freedom that move a body, (nbody, nv) bool."""
    moves = np.zeros((model.nbody, model.nv), dtype=bool)
    for body in range(1, model.nbody):
        moves[body] = moves[model.body_parentid[body]]
        first = model.body_dofadr[body]
        moves[body, first : first + model.body_dofnum[body]] = True
    return moves


def control_columns(model: mujoco.MjModel, actuator_ids: Iterable[int]) -> list[int]:
    """Return the columns of `ctrl` of the actuators, in order: none, one or several each."""
    starts, widths = model.actuator_ctrladr, model.actuator_ctrlnum
    return [int(starts[i]) + k for i in actuator_ids for k in range(widths[i])]


def force_columns(model: mujoco.MjModel, actuator_ids: Iterable[int]) -> list[int]:
    """Return the columns of `actuator_force` of the actuators, in order: one or several each."""
    starts, widths = model.actuator_outadr, model.actuator_outnum
    return [int(starts[i]) + k for i in actuator_ids for k in range(widths[i])]


def _members(enum: Any, prefix: str) -> dict[str, int]:
    return {
        name.removeprefix(prefix).lower(): int(value)
        for name, value in enum.__members__.items()
        if name.startswith(prefix)
    }


def _width(joint_type: int | mujoco.mjtJoint) -> tuple[int, int]:
    try:
        return _WIDTHS[int(joint_type)]
    except KeyError:
        raise ValueError(
            f"Unknown joint type {joint_type!r}; use a member of mujoco.mjtJoint "
            "(mjJNT_FREE, mjJNT_BALL, mjJNT_SLIDE or mjJNT_HINGE)."
        ) from None


def _has_affine_bias(actuator: mujoco.MjsActuator) -> bool:
    return (
        actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        and actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    )
