"""Entity spec construction: simulation options, joints, actuators, initial state.

Functions on specs and values; `Entity` calls them in the order of this file.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from mjlab.actuator.actuator import Actuator, ActuatorCfg, TransmissionType
from mjlab.actuator.xml_actuator import XML_TRANSMISSIONS, XmlActuatorCfg
from mjlab.utils.lab_api.string import resolve_matching_names
from mjlab.utils.mujoco import control_inputs, qpos_width
from mjlab.utils.spec import authored_position, compile_composed
from mjlab.utils.string import compile_pattern, first_matches

KEY_NAME = "init_state"
BIT_FIELDS = ("disableflags", "enableflags", "disableactuator")
"""Options that are bit masks of independent flags."""

_FREE = mujoco.mjtJoint.mjJNT_FREE
_BALL = mujoco.mjtJoint.mjJNT_BALL

# Elements that refer to others by name.
_REFERRING = ("tendons", "actuators", "sensors", "equalities", "pairs", "excludes")

# Order of MuJoCo's MJOPTION_FIELDS (mjxmacro.h), and of the bits in `spec.authored.option`. A bit
# tells an explicitly authored value from a default.
_AUTHORED_ORDER = (
    "timestep",
    "impratio",
    "tolerance",
    "ls_tolerance",
    "noslip_tolerance",
    "ccd_tolerance",
    "sleep_tolerance",
    "gravity",
    "wind",
    "magnetic",
    "density",
    "viscosity",
    "o_margin",
    "o_solref",
    "o_solimp",
    "o_friction",
    "integrator",
    "cone",
    "jacobian",
    "solver",
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
    "disableflags",
    "enableflags",
    "disableactuator",
    "sdf_initpoints",
    "sdf_iterations",
)


def copy_spec(spec: Any, function: str) -> mujoco.MjSpec:
    """Return a copy of a spec returned by the user's `function`; raise `ValueError` for other types.

    A copy, because editors and scenes modify the spec, and the function may return the same one
    twice. Copies omit elements that refer to nothing, such as actuators without `trntype`: a warning
    names them.
    """
    if not isinstance(spec, mujoco.MjSpec):
        raise ValueError(
            f"{function}: expected it to return mujoco.MjSpec, got {type(spec).__name__}; use e.g. "
            "mujoco.MjSpec.from_file(path)."
        )
    copy = spec.copy()
    lost = []
    for kind in _REFERRING:
        kept = [element.name for element in getattr(copy, kind)]
        own = [element.name for element in getattr(spec, kind)]
        if len(kept) < len(own):
            lost.append(f"{kind} {[name for name in own if name not in kept] or '(unnamed)'}")
    if lost:
        warnings.warn(
            f"Spec {spec.modelname!r}: dropped {', '.join(lost)}, because they refer to elements that "
            "are not in the spec, or have no `trntype`; correct the names, and set e.g. "
            "actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT.",
            UserWarning,
            stacklevel=2,
        )
    return copy


# Simulation options. A scene has one `<option>`, and attaching a spec drops the `<option>` of that
# spec. So options of entities are extracted before, and the scene decides which to apply.


@dataclass(frozen=True)
class EntityOptions:
    """Options that a spec states: authored in its XML, or different from MuJoCo's defaults."""

    values: dict[str, Any] = field(default_factory=dict)
    """Value by option field: a number, or a tuple for vectors."""
    switches: dict[str, tuple[int, int]] = field(default_factory=dict)
    """(bits set, bits stated) by field of `BIT_FIELDS`."""


def pop_options(spec: mujoco.MjSpec) -> EntityOptions:
    """Return the options that `spec` states, and reset its `<option>` to MuJoCo's defaults.

    Without the reset, MuJoCo warns at every attachment about lost values.
    """
    options, default = stated_options(spec), mujoco.MjSpec().option
    for name in _AUTHORED_ORDER:
        write_option(spec.option, name, getattr(default, name))
    spec.authored.option = 0
    for name in BIT_FIELDS:
        setattr(spec.authored, name, 0)
    return options


def stated_options(spec: mujoco.MjSpec) -> EntityOptions:
    """Return the options that `spec` states."""
    default = mujoco.MjSpec().option
    values = {}
    for position, name in enumerate(_AUTHORED_ORDER):
        value = getattr(spec.option, name)
        is_default = np.array_equal(value, getattr(default, name))
        if name not in BIT_FIELDS and (spec.authored.option >> position & 1 or not is_default):
            values[name] = tuple(value.tolist()) if isinstance(value, np.ndarray) else value
    switches = {}
    for name in BIT_FIELDS:
        bits = int(getattr(spec.option, name))
        stated = bits | int(getattr(spec.authored, name))
        if stated:
            switches[name] = (bits, stated)
    return EntityOptions(values, switches)


def write_option(option: Any, name: str, value: Any) -> None:
    """Set a scalar or vector field of a MuJoCo option block."""
    current = getattr(option, name)
    if isinstance(current, np.ndarray):
        current[:] = value
    else:
        setattr(option, name, value)


# Statements of the XML that attaching drops.


def scale_to_total_mass(spec: mujoco.MjSpec) -> None:
    """Apply `settotalmass` of `<compiler>`: scale all masses and inertias, and clear it.

    The other compiler settings belong to the elements, which keep them when they are attached.
    """
    total = spec.compiler.settotalmass
    if total <= 0:
        return
    spec.compiler.settotalmass = -1
    scale = total / compile_composed(spec.copy()).body_mass.sum()
    spec.compiler.boundmass *= scale
    spec.compiler.boundinertia *= scale
    for body in spec.bodies:
        body.mass *= scale
        body.inertia *= scale
        body.fullinertia *= scale
        for geom in body.geoms:
            # A geom has a mass or a density; a mass that is not given is NaN.
            geom.mass *= scale
            geom.density *= scale


# Joints, root body and names.


def find_joints(
    spec: mujoco.MjSpec,
) -> tuple[mujoco.MjsJoint | None, tuple[mujoco.MjsJoint, ...]]:
    """Return the free joint of `spec` (or None) and its hinges and slides. Names a free joint.

    Ball joints are passive: they are left out, with a warning.

    Raises:
        ValueError: several free joints.
    """
    joints = tuple(spec.joints)
    free = [joint for joint in joints if joint.type == _FREE]
    if len(free) > 1:
        raise ValueError(
            f"Spec {spec.modelname!r}: expected at most one free joint, got {len(free)}, of the bodies "
            f"{[joint.parent.name for joint in free]}; make each floating body a separate entity."
        )
    balls = [joint.name or f"(unnamed, of {joint.parent.name!r})" for joint in joints
             if joint.type == _BALL]  # fmt: skip
    if balls:
        warnings.warn(
            f"Spec {spec.modelname!r}: ball joints {balls} are passive: joint names, positions, "
            "targets and initial states leave them out, and resets return them to their reference; "
            "use three hinges for a joint to observe or drive.",
            UserWarning,
            stacklevel=2,
        )
    if free and not free[0].name:
        free[0].name = "floating_base_joint"
    scalar = tuple(joint for joint in joints if joint.type not in (_FREE, _BALL))
    return (free[0] if free else None), scalar


def place_body(body: mujoco.MjsBody, pose: tuple[float, ...]) -> None:
    """Set the pose of a body in its parent: position, quaternion (w, x, y, z)."""
    body.pos[:] = pose[:3]
    # An orientation in another form (such as euler) takes precedence over the quaternion.
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.quat[:] = pose[3:7]


def short_name(name: str) -> str:
    """Return an element's name within its entity: the part after the last '/'.

    Names of merged variant geoms are kept whole, because their last part is only a number.
    """
    _, merged, rest = name.partition("mjlab/pad/")
    return merged + rest if merged else name.rsplit("/", 1)[-1]


def short_names(elements: Iterable[Any]) -> tuple[str, ...]:
    """Return the names of spec elements within their entity."""
    return tuple(short_name(element.name) for element in elements)


Found = tuple[list[int], list[str]]
"""Ids within an entity, and names."""


def find_names(
    kind: str,
    name_keys: str | Sequence[str],
    names: Sequence[str],
    subset: Sequence[str] | None = None,
    preserve_order: bool = False,
) -> Found:
    """Find names by regular expressions, see `Entity`. Errors name the `kind` of element."""
    try:
        return resolve_matching_names(
            name_keys, names if subset is None else subset, preserve_order
        )
    except ValueError as error:
        raise ValueError(f"Patterns {name_keys!r} do not resolve to {kind}. {error}") from None


# Actuators.


def build_actuators(
    cfgs: Sequence[ActuatorCfg],
    spec: mujoco.MjSpec,
    joints: Sequence[mujoco.MjsJoint],
    build: Callable[[ActuatorCfg, list[int], list[str]], Actuator],
    sort: bool,
) -> list[Actuator]:
    """Build the configured actuators and add their elements to an entity's spec.

    Elements are added config by config, or, with `sort`, in the order of their targets (joints,
    tendons, sites), after the actuators of the XML.

    Args:
        cfgs: Actuator configs.
        spec: Spec of the entity.
        joints: Joints of the entity, without a free joint.
        build: Returns the actuator of a config, from ids and names of its targets in the entity.
        sort: Sort the elements.

    Raises:
        ValueError: the patterns of a config do not resolve (with reason and candidates); or a
            target already has an actuator, of another config, or of the XML with the name of the
            new one. Other XML actuators on a target stay active, and two `XmlActuatorCfg` may take
            over the same one, with a warning.
    """
    elements = {
        TransmissionType.JOINT: joints,
        TransmissionType.TENDON: spec.tendons,
        TransmissionType.SITE: spec.sites,
    }
    # Entity names omit the prefixes of attached specs, but spec elements refer to each other by
    # full names.
    full_names = {kind: [element.name for element in own] for kind, own in elements.items()}
    names = {kind: short_names(own) for kind, own in elements.items()}
    built = []
    for cfg in cfgs:
        ids, found = _find_targets(cfg, names)
        built.append((build(cfg, ids, found), [full_names[cfg.transmission_type][i] for i in ids]))
    _warn_second_actuators(spec, built)
    # XmlActuators first: they look up the XML's actuators before new ones are added.
    ordered = [pair for pair in built if isinstance(pair[0].cfg, XmlActuatorCfg)]
    added = [pair for pair in built if not isinstance(pair[0].cfg, XmlActuatorCfg)]
    if sort:
        order = [(kind, name) for kind, own in full_names.items() for name in own]
        single = [(actuator, [name]) for actuator, own in added for name in own]
        added = sorted(single, key=lambda pair: order.index((pair[0].transmission_type, *pair[1])))
    for actuator, targets in ordered + added:
        actuator.edit_spec(spec, targets)
    return [actuator for actuator, _ in built]


def _find_targets(
    cfg: ActuatorCfg, names: dict[TransmissionType, tuple[str, ...]]
) -> tuple[list[int], list[str]]:
    """Return ids and names of a config's targets; warn if elements of other kinds match too."""
    patterns, kind = cfg.target_names_expr, cfg.transmission_type
    compiled = [compile_pattern(pattern) for pattern in patterns]
    elsewhere = {
        other: [name for name in own if any(pattern.fullmatch(name) for pattern in compiled)]
        for other, own in names.items()
        if other != kind
    }
    label = (
        f"{type(cfg).__name__}(target_names_expr={patterns!r}, transmission_type={kind.value!r})"
    )
    try:
        ids, found = resolve_matching_names(patterns, names[kind])
    except ValueError as error:
        hints = [
            f"{other.value}s {also} (transmission_type=TransmissionType.{other.name})"
            for other, also in elsewhere.items()
            if also
        ]
        hint = f"\nThe patterns match: {'; '.join(hints)}." if hints else ""
        raise ValueError(f"{label}: {error}{hint}") from None
    if not found:
        raise ValueError(f"{label} matches no {kind.value}. Available: {list(names[kind])}.")
    if "" in found:
        raise ValueError(
            f"{label} matches an unnamed {kind.value}; name it in the XML, so that an actuator can "
            "refer to it."
        )
    for other, also in elsewhere.items():
        if all(any(pattern.fullmatch(name) for name in also) for pattern in compiled):
            warnings.warn(
                f"{label} acts on {kind.value}s, but its patterns also match the {other.value}s "
                f"{also}. Make the patterns unambiguous, or set transmission_type.",
                UserWarning,
                stacklevel=2,
            )
    return ids, found


def _warn_second_actuators(spec: mujoco.MjSpec, built: list[tuple[Actuator, list[str]]]) -> None:
    """Warn of targets with an actuator of the XML and one of a config, or with two XmlActuators."""
    in_xml = {
        (transmission, element.target)
        for element in spec.actuators
        for transmission, kinds in XML_TRANSMISSIONS.items()
        if element.trntype in kinds
    }
    wrapped: set[tuple[TransmissionType, str]] = set()
    for actuator, targets in built:
        cfg, own = actuator.cfg, {(actuator.transmission_type, name) for name in targets} & in_xml
        if isinstance(cfg, XmlActuatorCfg):
            both, outcome = own & wrapped, "the last config sets the control; narrow the patterns"
            wrapped |= own
        else:
            both = own
            outcome = (
                "their forces add up; remove the actuator from the XML if that is not intended"
            )
        if both:
            warnings.warn(
                f"{type(cfg).__name__}({cfg.target_names_expr!r}) acts on {cfg.transmission_type.value}s "
                f"that already have an actuator, {sorted(short_name(name) for _, name in both)}: {outcome}.",
                UserWarning,
                stacklevel=2,
            )


# Initial state.


@dataclass(frozen=True)
class XmlKey:
    """First keyframe of an entity's XML."""

    name: str
    qpos: tuple[float, ...]
    ctrl: tuple[float, ...]
    root_pos: tuple[float, ...] | None
    """Position of the free joint."""


@dataclass(frozen=True)
class InitialState:
    """Configured initial state, resolved for the joints and actuators of one entity."""

    root_state: tuple[float, ...]
    """Position, quaternion, linear and angular velocity; for a fixed base, only the pose."""
    joint_pos: tuple[float, ...]
    joint_vel: tuple[float, ...]
    qpos: dict[mujoco.MjsJoint, tuple[float, ...]]
    """`qpos` of each joint but ball joints, a free joint included, in spec order."""
    ctrl: dict[mujoco.MjsActuator, tuple[float, ...]]
    """Controls of each actuator, in spec order."""


def pop_keyframes(spec: mujoco.MjSpec) -> XmlKey | None:
    """Return the first keyframe of `spec`, and delete all keyframes.

    A keyframe holds all of `qpos` and `ctrl`, so a keyframe of the XML does not fit once actuators
    are added. The scene gets a keyframe with the resolved initial state.
    """
    keys = list(spec.keys)
    if not keys:
        return None
    qpos = tuple(keys[0].qpos)
    widths = [qpos_width(joint.type) for joint in spec.joints]
    free = [i for i, joint in enumerate(spec.joints) if joint.type == _FREE]
    start = sum(widths[: free[0]]) if free else 0
    root_pos = qpos[start : start + 3] if free and len(qpos) == sum(widths) else None
    first = XmlKey(keys[0].name, qpos, tuple(keys[0].ctrl), root_pos)
    if len(keys) > 1:
        warnings.warn(
            f"Spec {spec.modelname!r} has {len(keys)} keyframes: "
            f"{[key.name for key in keys]}. Only the first is used, and only if "
            "init_state.joint_pos is None; the others are dropped.",
            UserWarning,
            stacklevel=2,
        )
    for key in keys:
        spec.delete(key)
    return first


def resolve_initial_state(
    spec: mujoco.MjSpec,
    free_joint: mujoco.MjsJoint | None,
    joints: tuple[mujoco.MjsJoint, ...],
    xml_key: XmlKey | None,
    init: Any,
) -> InitialState:
    """Resolve `init`, an `EntityCfg.InitialStateCfg`, for the joints and actuators of `spec`.

    Raises:
        ValueError: a vector has the wrong length; `joint_pos` is None and the XML has no keyframe
            that fits.
    """
    for name, length in (("pos", 3), ("rot", 4), ("lin_vel", 3), ("ang_vel", 3)):
        if len(getattr(init, name)) != length:
            raise ValueError(
                f"init_state.{name}: expected {length} values, got {tuple(getattr(init, name))}."
            )
    pose = tuple(map(float, (*init.pos, *init.rot)))
    velocity = tuple(map(float, (*init.lin_vel, *init.ang_vel)))
    names = short_names(joints)
    if init.joint_pos is None:
        positions = _joint_pos_of_key(xml_key, spec, joints)
    else:
        xml_key = None
        positions = tuple(map(float, first_matches(init.joint_pos, names, 0.0)))
    values = {joint: (value,) for joint, value in zip(joints, positions, strict=True)}
    return InitialState(
        root_state=pose if free_joint is None else (*pose, *velocity),
        joint_pos=positions,
        joint_vel=tuple(map(float, first_matches(init.joint_vel, names, 0.0))),
        qpos={joint: values.get(joint, pose) for joint in spec.joints if joint.type != _BALL},
        ctrl=_initial_ctrl(spec, joints, positions, xml_key),
    )


def add_key(spec: mujoco.MjSpec, states: list[InitialState]) -> None:
    """Add the keyframe `init_state` to `spec`. `spec` holds the elements of `states`.

    Joints outside entities get the model's reference position; actuators outside entities get 0.
    """
    known_joints = {joint: v for state in states for joint, v in state.qpos.items()}
    known_ctrl = {actuator: u for state in states for actuator, u in state.ctrl.items()}
    qpos: list[float] = []
    for joint in spec.joints:
        if joint in known_joints:
            qpos += known_joints[joint]
        elif joint.type == _FREE:
            qpos += [*joint.parent.pos, *joint.parent.quat]
        elif joint.type == _BALL:
            qpos += [1.0, 0.0, 0.0, 0.0]
        else:
            qpos.append(authored_position(joint, joint.ref))
    ctrl = [
        value
        for actuator in spec.actuators
        for value in known_ctrl.get(actuator) or (0.0,) * len(control_inputs(actuator))
    ]
    spec.add_key(name=KEY_NAME, qpos=qpos, ctrl=ctrl)


def _joint_pos_of_key(
    key: XmlKey | None, spec: mujoco.MjSpec, joints: tuple[mujoco.MjsJoint, ...]
) -> tuple[float, ...]:
    """Return the joint positions of the keyframe; raise `ValueError` if it does not fit."""
    widths = [qpos_width(joint.type) for joint in spec.joints]
    if key is None or len(key.qpos) != sum(widths):
        found = "no keyframe" if key is None else f"keyframe {key.name!r} with {len(key.qpos)}"
        raise ValueError(
            f"init_state.joint_pos None: expected a keyframe with {sum(widths)} values in qpos, but "
            f"spec {spec.modelname!r} has {found}; add one, or set joint_pos to a dict of joint name "
            "pattern to position."
        )
    starts = dict(zip(spec.joints, itertools.accumulate(widths, initial=0), strict=False))
    return tuple(float(key.qpos[starts[joint]]) for joint in joints)


def _initial_ctrl(
    spec: mujoco.MjSpec,
    joints: tuple[mujoco.MjsJoint, ...],
    joint_pos: tuple[float, ...],
    key: XmlKey | None,
) -> dict[mujoco.MjsActuator, tuple[float, ...]]:
    """Return the controls that hold the joints at `joint_pos`, or those of a keyframe."""
    positions = {joint.name: value for joint, value in zip(joints, joint_pos, strict=True)}
    known = key.ctrl if key is not None else ()
    ctrl = {}
    for actuator in spec.actuators:
        inputs = control_inputs(actuator)
        # XML actuators come first, in the order of the keyframe.
        if len(inputs) <= len(known):
            ctrl[actuator] = tuple(map(float, known[: len(inputs)]))
        else:
            # Joint positions are commands of position inputs only.
            on_joint = actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
            held = positions.get(actuator.target, 0.0) if on_joint else 0.0
            ctrl[actuator] = tuple(held if kind == "position" else 0.0 for kind in inputs)
        known = known[len(inputs) :]
    return ctrl
