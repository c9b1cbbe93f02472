"""MjSpec functions: attaching, compilation, mocap base, joints, options, copies, actuators."""

from __future__ import annotations

import functools
import logging
import math
import operator
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
# Attributes of an element's place in its spec; not copied.
_NOT_DATA = {"name", "id", "signature", "classname", "compiler"}
_TRANSMISSIONS = {
    mujoco.MjsJoint: mujoco.mjtTrn.mjTRN_JOINT,
    mujoco.MjsTendon: mujoco.mjtTrn.mjTRN_TENDON,
    mujoco.MjsSite: mujoco.mjtTrn.mjTRN_SITE,
}
_VISUAL_BLOCKS = ("global_", "headlight", "map", "quality", "rgba", "scale")
_SIZES = ("memory", "nconmax", "njmax", "nuserdata") + tuple(
    f"nuser_{kind}"
    for kind in ("actuator", "body", "cam", "geom", "jnt", "sensor", "site", "tendon")
)
_BODIES = (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY)
_GEOM_SENSORS = (
    mujoco.mjtSensor.mjSENS_CONTACT,
    mujoco.mjtSensor.mjSENS_GEOMDIST,
    mujoco.mjtSensor.mjSENS_GEOMNORMAL,
    mujoco.mjtSensor.mjSENS_GEOMFROMTO,
)
_ON = mujoco.mjtLimited.mjLIMITED_TRUE
_OFF = mujoco.mjtLimited.mjLIMITED_FALSE


class TransmissionType(str, Enum):  # noqa: UP042 (part of the interface)
    """Type of actuator target."""

    JOINT = "joint"
    TENDON = "tendon"
    SITE = "site"


def attach(
    parent: mujoco.MjSpec, child: mujoco.MjSpec, prefix: str, frame: mujoco.MjsFrame
) -> None:
    """Attach `child` to a frame of `parent`. Its elements move to `parent`.

    Suppresses MuJoCo's warning about empty prefixes (printed and logged to a file): saved specs lose
    the names of default classes. `fix_spec_xml` fixes the XML saved by this package.
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


def pop_settings(spec: mujoco.MjSpec) -> dict[str, Any]:
    """Return visual settings, statistics and sizes other than MuJoCo's defaults, and reset them.

    Keys are paths below the spec, such as "visual.map.znear". Attaching drops these settings, and
    reports some of them as conflicts, without name and remedy.
    """
    default, found = mujoco.MjSpec(), {}
    for path in _setting_paths():
        initial, value = read_setting(default, path), read_setting(spec, path)
        if not np.array_equal(value, initial, equal_nan=True):
            found[path] = np.copy(value) if isinstance(value, np.ndarray) else value
    write_settings(spec, {path: read_setting(default, path) for path in found})
    for block in _VISUAL_BLOCKS:
        setattr(spec.authored, f"visual_{block.rstrip('_')}", 0)
    return found


def read_setting(spec: mujoco.MjSpec, path: str) -> Any:
    """Return the value of a path of `pop_settings`."""
    return operator.attrgetter(path)(spec)


def write_settings(spec: mujoco.MjSpec, values: dict[str, Any]) -> None:
    """Write values by path; see `pop_settings`."""
    for path, value in values.items():
        block, _, name = path.rpartition(".")
        setattr(read_setting(spec, block) if block else spec, name, value)


def _setting_paths() -> tuple[str, ...]:
    spec = mujoco.MjSpec()
    blocks = (*(f"visual.{block}" for block in _VISUAL_BLOCKS), "stat")
    return (
        *(f"{block}.{name}" for block in blocks for name in dir(read_setting(spec, block))
          if not name.startswith("_")),
        *_SIZES,
    )  # fmt: skip


def compile_composed(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a spec, suppressing MuJoCo's warning about empty prefixes; see `attach`.

    Links collide with the mocap base of their entity as with the world, in whose place it stands.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=_EMPTY_PREFIX)
        model = spec.compile()
    for base in range(1, model.nbody):
        if model.body(base).name.rsplit("/", 1)[-1] != MOCAP_BASE_NAME:
            continue
        welded = model.body_weldid == base
        # MuJoCo filters contacts between a body and its parent, but not with the world. Bases
        # without links keep their id, because rays are slower with geoms that are welded to the
        # world and placed by a mocap body.
        if (welded[model.body_parentid] & ~welded).any():
            model.body_weldid[welded] = 0
    return model


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile `spec` such that inertial frames may be randomized per environment.

    Raises:
        ValueError: the spec does not compile; contains MuJoCo's message.
    """
    for body in spec.bodies:
        # The compiler's shortcut for free bodies fixes a sparsity of the mass matrix that is invalid
        # for a randomized center of mass.
        body.simple = 0
    try:
        return compile_composed(spec)
    except ValueError as error:
        raise ValueError(f"The scene does not compile: {error}") from error


def auto_wrap_fixed_base_mocap(
    spec_fn: Callable[[], mujoco.MjSpec],
) -> Callable[[], mujoco.MjSpec]:
    """Wrap `spec_fn` such that fixed bases are attached to a mocap body.

    A spec without a free joint whose first body is not a mocap body is attached to a new mocap body
    `mocap_base`, so that each environment can place it by its mocap pose. References to the world
    body become references to `mocap_base`, which takes its place. Options, model name and keyframes
    of the spec are kept. Other specs are returned unchanged.

    The returned function raises `ValueError` if a spec to be wrapped contains a mocap body, because
    mocap bodies must be children of the world.
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
                f"Spec {spec.modelname!r}: fixed bases are attached to a mocap body, but mocap bodies "
                f"{nested} must be children of the world; make the mocap body the first body, or a "
                "separate entity."
            )
        return _under_mocap_base(spec)

    return wrapped


def _under_mocap_base(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    # Attaching moves the elements, and the function may return the same spec twice.
    child = spec.copy()
    make_asset_paths_absolute(child, spec.modelfiledir)
    parent = mujoco.MjSpec()
    parent.modelname = spec.modelname
    # Attaching drops the options; copied, because the scene reads the options of entities.
    for name in option_field_names():
        setattr(parent.option, name, getattr(spec.option, name))
    write_settings(parent, pop_settings(child))
    # Without mass, as the world: geoms of the world have none.
    base = parent.worldbody.add_body(
        name=MOCAP_BASE_NAME, mocap=True, explicitinertial=True, mass=0.0
    )
    for key in list(child.keys):
        child.delete(key)
    attach(parent, child, "", base.add_frame())
    _refer_to_base(parent)
    for key in spec.keys:
        fields = ("name", "time", "qpos", "qvel", "act", "ctrl")
        parent.add_key(**{field: getattr(key, field) for field in fields})
    return parent


def _refer_to_base(spec: mujoco.MjSpec) -> None:
    """Replace the world body by the mocap base in all elements that refer to it."""

    def replace(element: Any, field: str, *worlds: str) -> None:
        if getattr(element, field) in worlds:
            setattr(element, field, MOCAP_BASE_NAME)

    for equality in _body_equalities(spec):
        replace(equality, "name1", "world")
        # Without a second body, MuJoCo takes the world.
        replace(equality, "name2", "world", "")
    for exclude in spec.excludes:
        replace(exclude, "bodyname1", "world")
        replace(exclude, "bodyname2", "world")
    for sensor in spec.sensors:
        # Sensors of frames keep the world as their reference: it has the direction of gravity.
        is_of_geoms = sensor.type in _GEOM_SENSORS
        if is_of_geoms or _is_of_world(sensor):
            replace(sensor, "objname", "world")
        if is_of_geoms:
            replace(sensor, "refname", "world")
    for element in (*spec.cameras, *spec.lights):
        replace(element, "targetbody", "world")
    for actuator in spec.actuators:
        if actuator.trntype == mujoco.mjtTrn.mjTRN_BODY:
            replace(actuator, "target", "world")


def drop_references_to_world(spec: mujoco.MjSpec) -> list[str]:
    """Delete what MuJoCo cannot attach with a prefix, and return its descriptions.

    These are equalities with the world as first body, and sensors and actuators of the world. As
    second body, the world is kept.
    """
    dropped = []
    for equality in _body_equalities(spec):
        if equality.name2 == "world":
            equality.name2 = ""
        if equality.name1 == "world":
            dropped.append(f"equality {equality.name!r} of 'world' and {equality.name2!r}")
            spec.delete(equality)
    for sensor in filter(_is_of_world, spec.sensors):
        dropped.append(f"sensor {sensor.name!r} of 'world'")
        spec.delete(sensor)
    for actuator in spec.actuators:
        if actuator.trntype == mujoco.mjtTrn.mjTRN_BODY and actuator.target == "world":
            dropped.append(f"actuator {actuator.name!r} of 'world'")
            spec.delete(actuator)
    return dropped


def _is_of_world(sensor: mujoco.MjsSensor) -> bool:
    return sensor.objname == "world" and sensor.refname in ("", "world")


def _body_equalities(spec: mujoco.MjSpec) -> list[mujoco.MjsEquality]:
    links = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    return [one for one in spec.equalities if one.type in links and one.objtype in _BODIES]


def get_free_joint(spec: mujoco.MjSpec) -> mujoco.MjsJoint | None:
    """Return the first free joint of `spec`, or None."""
    return next((joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE), None)


def get_non_free_joints(spec: mujoco.MjSpec) -> tuple[mujoco.MjsJoint, ...]:
    """Return the joints in spec order, without free joints."""
    return tuple(joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE)


def is_joint_limited(jnt: mujoco.MjsJoint) -> bool:
    """Return True if `jnt` is limited: explicitly, or automatically by its range."""
    if jnt.limited == mujoco.mjtLimited.mjLIMITED_AUTO:
        return bool(jnt.range[0] < jnt.range[1])
    return jnt.limited == mujoco.mjtLimited.mjLIMITED_TRUE


def authored_position(target: Any, value: float) -> float:
    """Return a position of a spec's joint or tendon in SI units: XML may state angles in degrees."""
    angular = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL)
    is_angle = isinstance(target, mujoco.MjsJoint) and target.type in angular
    return math.radians(value) if is_angle and target.compiler.degree else float(value)


def option_field_names() -> tuple[str, ...]:
    """Return all field names of `<option>`."""
    return tuple(name for name in dir(mujoco.MjSpec().option) if not name.startswith("_"))


def non_default_option_fields(opt: Any) -> list[str]:
    """Return the field names of `spec.option` with values other than MuJoCo's defaults."""
    default = mujoco.MjSpec().option
    return [
        name
        for name in option_field_names()
        if not np.array_equal(getattr(opt, name), getattr(default, name))
    ]


def copy_mesh_data(src: mujoco.MjsMesh, dst: mujoco.MjsMesh) -> None:
    """Copy all attributes except the name. Raises `ValueError` if `dst` is unnamed."""
    _copy_data(src, dst)


def copy_texture_data(src: mujoco.MjsTexture, dst: mujoco.MjsTexture) -> None:
    """Copy all attributes except the name. Raises `ValueError` if `dst` is unnamed."""
    # Compilation keeps the pixels of a file in `data`, but not their number.
    is_read = src.file or any(src.cubefiles)
    _copy_data(src, dst, exclude=("data",) if is_read else ())


def copy_material_data(src: mujoco.MjsMaterial, dst: mujoco.MjsMaterial) -> None:
    """Copy all attributes except the name; textures by name. Raises `ValueError` if `dst` is unnamed."""
    _copy_data(src, dst)


def _copy_data(src: Any, dst: Any, exclude: Collection[str] = ()) -> None:
    if not dst.name:
        raise ValueError(
            f"Copy of {type(dst).__name__} {src.name!r}: expected a named destination; set its "
            "name first, because names must be unique in a spec and are not copied."
        )
    for field in dir(src):
        if field.startswith("_") or field in _NOT_DATA or field in exclude:
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
        spec: Spec to change.
        joint_name: Name of the joint or tendon with position l.
        stiffness: Position gain (N m/rad or N/m).
        damping: Velocity gain (N m s/rad or N s/m).
        effort_limit: E (N m or N). None: no limit.
        armature: Armature of the target (kg m^2 or kg). None: unchanged.
        frictionloss: Dry friction of the target (N m or N). None: unchanged.
        viscous_damping: Passive damping of the target (N m s/rad or N s/m). None: unchanged.
        transmission_type: Joint or tendon.
        actuator_name: Actuator name. None: name of the target.

    With an effort limit, the control range is the range of controls that changes the force; it is
    not enforced. A site has the position 0. Raises `ValueError` for an unknown target.
    """
    target = _target(spec, joint_name, transmission_type)
    _override(target, armature, frictionloss, viscous_damping)
    actuator = _add(spec, actuator_name or joint_name, target)
    _set_affine(actuator, stiffness, (0.0, -stiffness, -damping), effort_limit)
    if effort_limit is not None:
        limits = (0.0, 0.0) if isinstance(target, mujoco.MjsSite) else target.range
        lower, upper = (authored_position(target, value) for value in limits)
        # Without stiffness, the control has no effect.
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

    Arguments and errors as in `create_position_actuator`.
    """
    target = _target(spec, joint_name, transmission_type)
    _override(target, armature, frictionloss, viscous_damping)
    actuator = _add(spec, actuator_name or joint_name, target)
    _set_affine(actuator, damping, (0.0, 0.0, -damping), effort_limit)
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

    Raises `ValueError` for an unknown target. A site ignores armature, frictionloss and damping.
    """
    target = _target(spec, joint_name, transmission_type)
    _override(target, armature, frictionloss, viscous_damping)
    actuator = _add(spec, joint_name, target)
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    actuator.gainprm[0] = 1.0
    actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
    actuator.gear[0] = gear
    actuator.forcelimited = actuator.ctrllimited = _ON
    actuator.forcerange[:] = actuator.ctrlrange[:] = (-effort_limit, effort_limit)
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
    """Add a muscle with MuJoCo's parameters, driven by an excitation in [0, 1].

    Raises `ValueError` for a site or an unknown target.
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
    """Write passive properties that are not None to the joint or tendon.

    Raises `ValueError` for an unknown target. A site ignores the properties, with a warning.
    """
    target = _target(spec, target_name, transmission_type)
    _override(target, armature, frictionloss, viscous_damping)


def _target(spec: mujoco.MjSpec, name: str, transmission_type: Any, allow_site: bool = True) -> Any:
    """Return the target joint, tendon or site."""
    kind = getattr(transmission_type, "value", transmission_type)
    check_one_of("transmission_type", kind, [member.value for member in TransmissionType])
    if kind == "site" and not allow_site:
        raise ValueError(
            f"Site {name!r}: expected a joint or a tendon, because muscles have a length."
        )
    check_exists(kind, name, [element.name for element in getattr(spec, f"{kind}s")])
    return getattr(spec, kind)(name)


def _override(
    target: Any,
    armature: float | None,
    frictionloss: float | None,
    viscous_damping: float | None,
) -> None:
    """Write passive properties that are not None. Sites have none: warn."""
    if isinstance(target, mujoco.MjsSite):
        if armature or frictionloss or viscous_damping:
            warnings.warn(
                f"Site {target.name!r}: expected no passive properties, got armature {armature}, "
                f"frictionloss {frictionloss} and viscous_damping {viscous_damping}; they are not used.",
                UserWarning,
                stacklevel=4,
            )
        return
    if armature is not None:
        target.armature = armature
    if frictionloss is not None:
        target.frictionloss = frictionloss
    if viscous_damping is not None:
        # The other entries are coefficients of higher-order damping.
        target.damping[0] = viscous_damping


def _add(spec: mujoco.MjSpec, name: str, target: Any) -> mujoco.MjsActuator:
    trntype = _TRANSMISSIONS[type(target)]
    # Clear inputs from the spec's default class, such as those of <pid>.
    return spec.add_actuator(name=name, target=target.name, trntype=trntype, ctrlspec=0)


def _set_affine(
    actuator: mujoco.MjsActuator,
    gain: float,
    bias: tuple[float, float, float],
    effort_limit: float | None,
) -> None:
    """Set force = gain u + bias . (1, l, l'), clamped to the effort limit."""
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
    actuator.gainprm[0] = gain
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.biasprm[:3] = bias
    actuator.ctrllimited = _OFF
    actuator.inheritrange = 0.0
    actuator.forcelimited = _OFF if effort_limit is None else _ON
    if effort_limit is not None:
        actuator.forcerange[:] = (-effort_limit, effort_limit)


__getattr__ = older_names(__name__)
