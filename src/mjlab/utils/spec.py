"""Functions on MuJoCo specs: joints, options, copies, the mocap wrap, export, new actuators."""

from __future__ import annotations

import functools
import logging
import warnings
from collections.abc import Callable, Collection
from enum import Enum
from typing import Any

import mujoco
import numpy as np

from mjlab.compat import older_names
from mjlab.utils.errors import check_exists, check_one_of
from mjlab.utils.xml import (  # noqa: F401
    export_spec,
    make_asset_paths_absolute,
    put_files_in_memory,
)

logger = logging.getLogger(__name__)
MOCAP_BASE_NAME = "mocap_base"
_EMPTY_PREFIX = "Attaching a spec with an empty prefix"
# What belongs to an element's place in its spec rather than to what it is.
_NOT_DATA = {"name", "id", "signature", "classname", "compiler"}
_TRANSMISSIONS = {
    mujoco.MjsJoint: mujoco.mjtTrn.mjTRN_JOINT,
    mujoco.MjsTendon: mujoco.mjtTrn.mjTRN_TENDON,
    mujoco.MjsSite: mujoco.mjtTrn.mjTRN_SITE,
}
_ON = mujoco.mjtLimited.mjLIMITED_TRUE
_OFF = mujoco.mjtLimited.mjLIMITED_FALSE


class TransmissionType(str, Enum):  # noqa: UP042 (part of the interface)
    """What an actuator acts on."""

    JOINT = "joint"
    TENDON = "tendon"
    SITE = "site"


def attach(
    parent: mujoco.MjSpec, child: mujoco.MjSpec, prefix: str, frame: mujoco.MjsFrame
) -> None:
    """Attach `child` to a frame of `parent`; its elements move there.

    Without a prefix MuJoCo prints, and logs to a file, that such a spec may not be saved correctly:
    default classes lose their names. What this package saves, it repairs (`fix_spec_xml`).
    """
    handler = mujoco.get_mju_user_warning()
    messages: list[str] = []
    mujoco.set_mju_user_warning(messages.append)
    try:
        parent.attach(child, prefix=prefix, frame=frame)
    finally:
        mujoco.set_mju_user_warning(handler)
    for message in messages:
        if not message.startswith(_EMPTY_PREFIX):
            logger.warning(message)


def compile_composed(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a spec without MuJoCo's warning about empty prefixes; see `attach`."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=_EMPTY_PREFIX)
        return spec.compile()


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile `spec` so that inertial frames may differ between environments afterwards.

    Raises:
        ValueError: the spec does not compile, with MuJoCo's message.
    """
    for body in spec.bodies:
        # The compiler's shortcut for free bodies fixes the sparsity of the mass matrix, which a
        # randomized centre of mass would need in full.
        body.simple = 0
    try:
        return compile_composed(spec)
    except ValueError as error:
        raise ValueError(f"The scene does not compile: {error}") from error


def auto_wrap_fixed_base_mocap(
    spec_fn: Callable[[], mujoco.MjSpec],
) -> Callable[[], mujoco.MjSpec]:
    """Return a function like `spec_fn` whose specs have a base that can be placed freely.

    A spec without a free joint, whose first body is no mocap body, is put under a new mocap body
    `mocap_base`: each environment can then place it by writing the mocap pose. Options, model
    name and keyframes of the spec are kept. Other specs are returned as they are.

    The new function raises `ValueError` for a spec to be wrapped that has a mocap body further
    down, since mocap bodies must be children of the world.
    """

    @functools.wraps(spec_fn)
    def wrapped() -> mujoco.MjSpec:
        spec = spec_fn()
        bodies = spec.bodies[1:]
        if get_free_joint(spec) is not None or (bodies and bodies[0].mocap):
            return spec
        nested = [body.name for body in bodies if body.mocap]
        if nested:
            raise ValueError(
                f"The spec {spec.modelname!r} has a fixed base, which is put under a mocap body, "
                f"but has mocap bodies itself: {nested}. Mocap bodies must be children of the "
                "world: make it the first body, or an entity of its own."
            )
        return _under_mocap_base(spec)

    return wrapped


def _under_mocap_base(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    # Attaching moves the elements away, so a function that returns one spec twice needs a copy.
    child = spec.copy()
    make_asset_paths_absolute(child, spec.modelfiledir)
    parent = mujoco.MjSpec()
    parent.modelname = spec.modelname
    # Attaching drops the options; kept here, the scene still sees what the entity asked for.
    for name in option_field_names():
        setattr(parent.option, name, getattr(spec.option, name))
    base = parent.worldbody.add_body(name=MOCAP_BASE_NAME, mocap=True)
    for key in list(child.keys):
        child.delete(key)
    attach(parent, child, "", base.add_frame())
    for key in spec.keys:
        fields = ("name", "time", "qpos", "qvel", "act", "ctrl")
        parent.add_key(**{field: getattr(key, field) for field in fields})
    return parent


def get_free_joint(spec: mujoco.MjSpec) -> mujoco.MjsJoint | None:
    """Return the first free joint of the spec, or None."""
    return next((joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE), None)


def get_non_free_joints(spec: mujoco.MjSpec) -> tuple[mujoco.MjsJoint, ...]:
    """Return the joints that are not free, in spec order."""
    return tuple(joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE)


def is_joint_limited(jnt: mujoco.MjsJoint) -> bool:
    """Return whether the joint has limits: it says so, or leaves it open and has a range."""
    if jnt.limited == mujoco.mjtLimited.mjLIMITED_AUTO:
        return bool(jnt.range[0] < jnt.range[1])
    return jnt.limited == mujoco.mjtLimited.mjLIMITED_TRUE


def option_field_names() -> tuple[str, ...]:
    """Return the names of all fields of a spec's `<option>`."""
    return tuple(name for name in dir(mujoco.MjSpec().option) if not name.startswith("_"))


def non_default_option_fields(opt: Any) -> list[str]:
    """Return the names of the fields of `spec.option` that differ from MuJoCo's defaults."""
    default = mujoco.MjSpec().option
    return [
        name
        for name in option_field_names()
        if not np.array_equal(getattr(opt, name), getattr(default, name))
    ]


def copy_mesh_data(src: mujoco.MjsMesh, dst: mujoco.MjsMesh) -> None:
    """Copy everything but the name. `ValueError` if `dst` has no name yet."""
    _copy_data(src, dst)


def copy_texture_data(src: mujoco.MjsTexture, dst: mujoco.MjsTexture) -> None:
    """Copy everything but the name. `ValueError` if `dst` has no name yet."""
    # Compiling keeps the pixels of a file in `data`, but not their number.
    is_read = src.file or any(src.cubefiles)
    _copy_data(src, dst, leave_out=("data",) if is_read else ())


def copy_material_data(src: mujoco.MjsMaterial, dst: mujoco.MjsMaterial) -> None:
    """Copy everything but the name, textures by name. `ValueError` if `dst` has no name yet."""
    _copy_data(src, dst)


def _copy_data(src: Any, dst: Any, leave_out: Collection[str] = ()) -> None:
    if not dst.name:
        raise ValueError(
            f"The {type(dst).__name__} to copy {src.name!r} into has no name. "
            "Name it first: names must be unique in a spec, so they are not copied."
        )
    for field in dir(src):
        if field.startswith("_") or field in _NOT_DATA or field in leave_out:
            continue
        value = getattr(src, field)
        if callable(value) or (field == "plugin" and not value.active):
            continue
        setattr(dst, field, value)


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
    _override(target, armature, frictionloss, viscous_damping)
    actuator = _add(spec, actuator_name or joint_name, target)
    _set_affine(actuator, gain=stiffness, bias=(0.0, -stiffness, -damping))
    _set_effort_limit(actuator, effort_limit)
    if effort_limit is not None:
        lower, upper = _authored_range(target)
        # Without stiffness the control has no effect, and no distance is needed for full effort.
        reach = effort_limit / stiffness if stiffness > 0 else 0.0
        actuator.ctrlrange[:] = (lower - reach, upper + reach)
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
    _override(target, armature, frictionloss, viscous_damping)
    actuator = _add(spec, actuator_name or joint_name, target)
    _set_affine(actuator, gain=damping, bias=(0.0, 0.0, -damping))
    _set_effort_limit(actuator, effort_limit)
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
    _override(target, armature, frictionloss, viscous_damping)
    actuator = _add(spec, joint_name, target)
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    actuator.gainprm[0] = 1.0
    actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
    actuator.gear[0] = gear
    _set_effort_limit(actuator, effort_limit)
    actuator.ctrllimited = _ON
    actuator.ctrlrange[:] = (-effort_limit, effort_limit)
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
    target = _target(spec, target_name, transmission_type, allow_site=False)
    actuator = _add(spec, target_name, target)
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
    _override(target, armature, frictionloss, viscous_damping)


def _target(spec: mujoco.MjSpec, name: str, transmission_type: Any, allow_site: bool) -> Any:
    """Return the joint, tendon or site to act on."""
    kind = getattr(transmission_type, "value", transmission_type)
    check_one_of("transmission_type", kind, [member.value for member in TransmissionType])
    if kind == "site" and not allow_site:
        raise ValueError(
            f"Only motors can act on a site, not this kind of actuator (site {name!r}). "
            "Use a joint or a tendon."
        )
    check_exists(kind, name, [element.name for element in getattr(spec, f"{kind}s")])
    return getattr(spec, kind)(name)


def _override(
    target: Any,
    armature: float | None,
    frictionloss: float | None,
    viscous_damping: float | None,
) -> None:
    """Write the passive properties that are not None; a site has none."""
    if isinstance(target, mujoco.MjsSite):
        if armature or frictionloss or viscous_damping:
            raise ValueError(
                f"Site {target.name!r}: expected no passive properties, got armature {armature}, "
                f"frictionloss {frictionloss} and viscous_damping {viscous_damping}."
            )
        return
    if armature is not None:
        target.armature = armature
    if frictionloss is not None:
        target.frictionloss = frictionloss
    if viscous_damping is not None:
        # The other entries are coefficients of damping that grows with speed.
        target.damping[0] = viscous_damping


def _add(spec: mujoco.MjSpec, name: str, target: Any) -> mujoco.MjsActuator:
    trntype = _TRANSMISSIONS[type(target)]
    # Inputs of the spec's default, such as those of a <pid>, are not those of this kind.
    return spec.add_actuator(name=name, target=target.name, trntype=trntype, ctrlspec=0)


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


__getattr__ = older_names(__name__)
