"""The state an entity starts from: resolving the config, and the keyframe that shows it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco

from mjlab.utils.mujoco import control_inputs, qpos_width
from mjlab.utils.string import resolve_expr

if TYPE_CHECKING:
    from mjlab.entity.entity import EntityCfg

KEY_NAME = "init_state"


@dataclass(frozen=True)
class XmlKey:
    """The first keyframe of an entity's XML."""

    name: str
    qpos: tuple[float, ...]
    ctrl: tuple[float, ...]


@dataclass(frozen=True)
class InitialState:
    """The configured initial state, resolved for one entity's joints and actuators."""

    root_state: tuple[float, ...]
    """Position, quaternion, linear and angular velocity; only the pose with a fixed base."""
    joint_pos: tuple[float, ...]
    joint_vel: tuple[float, ...]
    qpos: dict[mujoco.MjsJoint, tuple[float, ...]]
    """The values of each joint, the free one included, in spec order."""
    ctrl: dict[mujoco.MjsActuator, tuple[float, ...]]
    """The controls of each actuator, in spec order."""


def take_keys(spec: mujoco.MjSpec) -> XmlKey | None:
    """Return the first keyframe of `spec`, and delete all of them.

    A keyframe holds the whole of `qpos` and `ctrl`, so one made for the XML alone does not fit
    once actuators are added. The scene gets a keyframe made from the resolved initial state.
    """
    keys = list(spec.keys)
    if not keys:
        return None
    first = XmlKey(keys[0].name, tuple(keys[0].qpos), tuple(keys[0].ctrl))
    if len(keys) > 1:
        warnings.warn(
            f"The spec {spec.modelname!r} has {len(keys)} keyframes: "
            f"{[key.name for key in keys]}. Only the first is used, and only where "
            "init_state.joint_pos is None; the others are dropped.",
            UserWarning,
            stacklevel=2,
        )
    for key in keys:
        spec.delete(key)
    return first


def resolve_initial_state(
    cfg: EntityCfg,
    spec: mujoco.MjSpec,
    free_joint: mujoco.MjsJoint | None,
    joints: tuple[mujoco.MjsJoint, ...],
    xml_key: XmlKey | None,
) -> InitialState:
    """Resolve `cfg.init_state` for the joints and actuators of `spec`.

    Raises:
        ValueError: a vector has the wrong length; `joint_pos` is None and the XML has no keyframe
            that fits.
    """
    init = cfg.init_state
    names = tuple(short_name(joint.name) for joint in joints)
    pose = (*_vector(init.pos, 3, "pos"), *_vector(init.rot, 4, "rot"))
    velocity = (*_vector(init.lin_vel, 3, "lin_vel"), *_vector(init.ang_vel, 3, "ang_vel"))
    joint_vel = _floats(resolve_expr(init.joint_vel, names, 0.0))
    if init.joint_pos is None:
        joint_pos = _joint_pos_of_key(xml_key, spec, joints)
    else:
        joint_pos = _floats(resolve_expr(init.joint_pos, names, 0.0))
    values: dict[mujoco.MjsJoint, tuple[float, ...]] = {
        joint: (value,) for joint, value in zip(joints, joint_pos, strict=True)
    }
    if free_joint is not None:
        values[free_joint] = pose
    return InitialState(
        root_state=pose if free_joint is None else (*pose, *velocity),
        joint_pos=joint_pos,
        joint_vel=joint_vel,
        qpos={joint: values[joint] for joint in spec.joints},
        ctrl=_ctrl(spec, joints, joint_pos, xml_key if init.joint_pos is None else None),
    )


def add_key(spec: mujoco.MjSpec, states: list[InitialState]) -> None:
    """Add the keyframe `init_state` to `spec`, which holds the elements of `states`.

    Joints and actuators that belong to no entity take the model's own reference and zero.
    """
    known_joints = {joint: v for state in states for joint, v in state.qpos.items()}
    known_ctrl = {actuator: u for state in states for actuator, u in state.ctrl.items()}
    qpos: list[float] = []
    for joint in spec.joints:
        values = known_joints.get(joint)
        qpos.extend(_reference(joint) if values is None else values)
    ctrl = [
        value
        for actuator in spec.actuators
        for value in known_ctrl.get(actuator) or (0.0,) * len(control_inputs(actuator))
    ]
    spec.add_key(name=KEY_NAME, qpos=qpos, ctrl=ctrl)


def short_name(name: str) -> str:
    """Return the part of an element's name after the last '/', which is its name in its entity.

    Names that merged variants give to geoms are kept whole: their last part is but a number.
    """
    _, merged, rest = name.partition("mjlab/pad/")
    return merged + rest if merged else name.rsplit("/", 1)[-1]


def _reference(joint: mujoco.MjsJoint) -> list[float]:
    """Return what the compiler puts into `qpos0` for a joint."""
    if joint.type == mujoco.mjtJoint.mjJNT_FREE:
        return [*joint.parent.pos, *joint.parent.quat]
    if joint.type == mujoco.mjtJoint.mjJNT_BALL:
        return [1.0, 0.0, 0.0, 0.0]
    in_degrees = joint.type == mujoco.mjtJoint.mjJNT_HINGE and joint.compiler.degree
    return [math.radians(joint.ref) if in_degrees else float(joint.ref)]


def _ctrl(
    spec: mujoco.MjSpec,
    joints: tuple[mujoco.MjsJoint, ...],
    joint_pos: tuple[float, ...],
    key: XmlKey | None,
) -> dict[mujoco.MjsActuator, tuple[float, ...]]:
    """Return the controls that hold the joints at `joint_pos`, or those of a keyframe."""
    positions = {joint.name: value for joint, value in zip(joints, joint_pos, strict=True)}
    known = key.ctrl if key is not None else ()
    ctrl, start = {}, 0
    for actuator in spec.actuators:
        inputs = control_inputs(actuator)
        stop = start + len(inputs)
        # The actuators that the XML itself has come first, in the order of its keyframe.
        if stop <= len(known):
            ctrl[actuator] = tuple(map(float, known[start:stop]))
        else:
            # A joint position is no sensible force, speed or activation.
            on_joint = actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
            held = positions.get(actuator.target, 0.0) if on_joint else 0.0
            ctrl[actuator] = tuple(held if what == "position" else 0.0 for what in inputs)
        start = stop
    return ctrl


def _joint_pos_of_key(
    key: XmlKey | None, spec: mujoco.MjSpec, joints: tuple[mujoco.MjsJoint, ...]
) -> tuple[float, ...]:
    if key is None:
        raise ValueError(
            "init_state.joint_pos is None, which takes the joint positions from the first "
            f"keyframe of the XML, but the spec {spec.modelname!r} has no keyframe. Add one, or "
            "give joint_pos as a dict of joint name pattern to position."
        )
    expected = sum(qpos_width(joint.type) for joint in spec.joints)
    if len(key.qpos) != expected:
        raise ValueError(
            "init_state.joint_pos is None, which takes the joint positions from the keyframe "
            f"{key.name!r}, but that has {len(key.qpos)} values in qpos and the spec "
            f"{spec.modelname!r} needs {expected}."
        )
    start, values = 0, {}
    for joint in spec.joints:
        values[joint] = key.qpos[start]
        start += qpos_width(joint.type)
    return _floats(values[joint] for joint in joints)


def _floats(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _vector(values: tuple[float, ...], length: int, what: str) -> tuple[float, ...]:
    if len(values) != length:
        raise ValueError(
            f"init_state.{what} has {len(values)} values ({tuple(values)}); it needs {length}."
        )
    return _floats(values)
