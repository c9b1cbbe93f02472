"""Adding actuators to a spec, with the passive properties of the joint or tendon they drive."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

if TYPE_CHECKING:
    from mjlab.actuator.actuator import TransmissionType

# Transmission types are compared by value: their enum belongs to a layer above.
_TRANSMISSIONS = {
    "joint": mujoco.mjtTrn.mjTRN_JOINT,
    "tendon": mujoco.mjtTrn.mjTRN_TENDON,
    "site": mujoco.mjtTrn.mjTRN_SITE,
}
_ON = mujoco.mjtLimited.mjLIMITED_TRUE
_OFF = mujoco.mjtLimited.mjLIMITED_FALSE


def create_position_actuator(
    spec: mujoco.MjSpec,
    joint_name: str,
    *,
    stiffness: float,
    damping: float,
    effort_limit: float | None = None,
    armature: float | None = None,
    frictionloss: float | None = None,
    viscous_damping: float | None = None,
    transmission_type: TransmissionType | str = "joint",
    actuator_name: str | None = None,
) -> mujoco.MjsActuator:
    """Add a position servo: force = clamp(stiffness (u - l) - damping l', -E, E).

    Args:
        spec: The spec to change.
        joint_name: Name of the joint or tendon with position l.
        stiffness: N m/rad or N/m.
        damping: N m s/rad or N s/m.
        effort_limit: E, in N m or N; None for no limit.
        armature: Overrides the target's; None keeps it. So do the next two.
        frictionloss: N m or N.
        viscous_damping: N m s/rad or N s/m.
        transmission_type: Joint or tendon.
        actuator_name: None takes the target's name.

    With an effort limit the control range tells which targets can make a difference; it is
    written but not enforced. Raises `ValueError` for a site, or a target that does not exist.
    """
    target = _target(spec, joint_name, transmission_type, allow_site=False)
    actuator = _add(spec, actuator_name or joint_name, joint_name, transmission_type)
    _set_affine(actuator, gain=stiffness, bias=(0.0, -stiffness, -damping))
    _set_effort_limit(actuator, effort_limit)
    if effort_limit is not None:
        lower, upper = _authored_range(target)
        # Without stiffness the control has no effect, and no distance is needed for full effort.
        reach = effort_limit / stiffness if stiffness > 0 else 0.0
        actuator.ctrlrange[:] = (lower - reach, upper + reach)
    _override(target, armature, frictionloss, viscous_damping)
    return actuator


def create_velocity_actuator(
    spec: mujoco.MjSpec,
    joint_name: str,
    *,
    damping: float,
    effort_limit: float | None = None,
    armature: float | None = None,
    frictionloss: float | None = None,
    viscous_damping: float | None = None,
    transmission_type: TransmissionType | str = "joint",
    actuator_name: str | None = None,
) -> mujoco.MjsActuator:
    """Add a velocity servo: force = clamp(damping (u - l'), -E, E).

    Arguments and errors are those of `create_position_actuator`.
    """
    target = _target(spec, joint_name, transmission_type, allow_site=False)
    actuator = _add(spec, actuator_name or joint_name, joint_name, transmission_type)
    _set_affine(actuator, gain=damping, bias=(0.0, 0.0, -damping))
    _set_effort_limit(actuator, effort_limit)
    _override(target, armature, frictionloss, viscous_damping)
    return actuator


def create_motor_actuator(
    spec: mujoco.MjSpec,
    joint_name: str,
    *,
    effort_limit: float,
    gear: float = 1.0,
    armature: float | None = None,
    frictionloss: float | None = None,
    viscous_damping: float | None = None,
    transmission_type: TransmissionType | str = "joint",
) -> mujoco.MjsActuator:
    """Add a motor: force on the target = gear clamp(u, -E, E), with E = `effort_limit` (or inf).

    Raises `ValueError` for a target that does not exist, and for a site with an armature, friction
    loss or damping, which a site does not have.
    """
    target = _target(spec, joint_name, transmission_type, allow_site=True)
    if _value(transmission_type) == "site":
        _refuse_on_site(joint_name, armature, frictionloss, viscous_damping)
    actuator = _add(spec, joint_name, joint_name, transmission_type)
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    actuator.gainprm[0] = 1.0
    actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
    actuator.gear[0] = gear
    _set_effort_limit(actuator, effort_limit)
    actuator.ctrllimited = _ON
    actuator.ctrlrange[:] = (-effort_limit, effort_limit)
    if _value(transmission_type) != "site":
        _override(target, armature, frictionloss, viscous_damping)
    return actuator


def create_muscle_actuator(
    spec: mujoco.MjSpec,
    target_name: str,
    *,
    length_range: tuple[float, float] = (0.0, 0.0),
    gear: float = 1.0,
    timeconst: tuple[float, float] = (0.01, 0.04),
    tausmooth: float = 0.0,
    range: tuple[float, float] = (0.75, 1.05),
    force: float = -1.0,
    scale: float = 200.0,
    lmin: float = 0.5,
    lmax: float = 1.6,
    vmax: float = 1.5,
    fpmax: float = 1.3,
    fvmax: float = 1.2,
    transmission_type: TransmissionType | str = "tendon",
) -> mujoco.MjsActuator:
    """Add a muscle with MuJoCo's parameters, driven by an excitation from 0 to 1.

    Raises `ValueError` for a site, or a target that does not exist.
    """
    _target(spec, target_name, transmission_type, allow_site=False)
    actuator = _add(spec, target_name, target_name, transmission_type)
    actuator.dyntype = mujoco.mjtDyn.mjDYN_MUSCLE
    actuator.gaintype = mujoco.mjtGain.mjGAIN_MUSCLE
    actuator.biastype = mujoco.mjtBias.mjBIAS_MUSCLE
    curve = (*range, force, scale, lmin, lmax, vmax, fpmax, fvmax)
    actuator.dynprm[:3] = (*timeconst, tausmooth)
    actuator.gainprm[: len(curve)] = curve
    actuator.biasprm[: len(curve)] = curve
    actuator.lengthrange[:] = length_range
    actuator.gear[0] = gear
    actuator.ctrllimited = _ON
    actuator.ctrlrange[:] = (0.0, 1.0)
    return actuator


def apply_target_overrides(
    spec: mujoco.MjSpec,
    target_name: str,
    transmission_type: TransmissionType | str,
    *,
    armature: float | None,
    frictionloss: float | None,
    viscous_damping: float | None,
) -> None:
    """Write the passive properties that are not None to the joint or tendon.

    Raises `ValueError` for a target that does not exist, and for a site if one of them is positive.
    """
    target = _target(spec, target_name, transmission_type, allow_site=True)
    if _value(transmission_type) == "site":
        _refuse_on_site(target_name, armature, frictionloss, viscous_damping)
    else:
        _override(target, armature, frictionloss, viscous_damping)


def _value(transmission_type: Any) -> str:
    value = getattr(transmission_type, "value", transmission_type)
    if value not in _TRANSMISSIONS:
        raise ValueError(
            f"Unknown transmission type {transmission_type!r}; use one of {list(_TRANSMISSIONS)}."
        )
    return value


def _target(spec: mujoco.MjSpec, name: str, transmission_type: Any, allow_site: bool) -> Any:
    kind = _value(transmission_type)
    if kind == "site" and not allow_site:
        raise ValueError(
            f"Only motors can act on a site, not this kind of actuator (site {name!r}). "
            "Use a joint or a tendon."
        )
    found = getattr(spec, kind)(name)
    if found is None:
        names = [element.name for element in getattr(spec, f"{kind}s")]
        raise ValueError(f"There is no {kind} {name!r} to put an actuator on. There are: {names}.")
    return found


def _add(spec: mujoco.MjSpec, name: str, target: str, transmission_type: Any) -> mujoco.MjsActuator:
    trntype = _TRANSMISSIONS[_value(transmission_type)]
    # Inputs of the spec's default, such as those of a <pid>, are not those of this kind.
    return spec.add_actuator(name=name, target=target, trntype=trntype, ctrlspec=0)


def _set_affine(
    actuator: mujoco.MjsActuator, gain: float, bias: tuple[float, float, float]
) -> None:
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    actuator.gainprm[0] = gain
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.biasprm[:3] = bias
    actuator.ctrllimited = _OFF
    actuator.inheritrange = 0.0


def _set_effort_limit(actuator: mujoco.MjsActuator, effort_limit: float | None) -> None:
    if effort_limit is None:
        actuator.forcelimited = _OFF
        return
    actuator.forcelimited = _ON
    actuator.forcerange[:] = (-effort_limit, effort_limit)


def _authored_range(target: Any) -> tuple[float, float]:
    """Return the range in SI units; a spec read from XML may still hold degrees."""
    lower, upper = float(target.range[0]), float(target.range[1])
    angular = isinstance(target, mujoco.MjsJoint) and target.type in (
        mujoco.mjtJoint.mjJNT_HINGE,
        mujoco.mjtJoint.mjJNT_BALL,
    )
    if angular and target.compiler.degree:
        return float(np.deg2rad(lower)), float(np.deg2rad(upper))
    return lower, upper


def _override(
    target: Any,
    armature: float | None,
    frictionloss: float | None,
    viscous_damping: float | None,
) -> None:
    if armature is not None:
        target.armature = armature
    if frictionloss is not None:
        target.frictionloss = frictionloss
    if viscous_damping is not None:
        # The other entries are coefficients of damping that grows with speed.
        target.damping[0] = viscous_damping


def _refuse_on_site(
    name: str,
    armature: float | None,
    frictionloss: float | None,
    viscous_damping: float | None,
) -> None:
    given = {
        "armature": armature,
        "frictionloss": frictionloss,
        "viscous_damping": viscous_damping,
    }
    positive = {key: value for key, value in given.items() if value}
    if positive:
        raise ValueError(f"{positive} given for the site {name!r}, but a site has none of these.")
