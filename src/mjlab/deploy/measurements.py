"""Measurements: raw sensor values that the observations of a policy are computed from.

A measurement says what a robot must supply (shape, unit, frame, and if robots can measure it), how plain
MuJoCo gives it (`source`), and how the environment gives it (`read`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.deploy import availability
from mjlab.deploy.availability import Availability, Reason
from mjlab.utils.lab_api.math import subtract_frame_transforms
from mjlab.utils.random import preserved_rng
from mjlab.utils.state import changes_undone, is_stateful
from mjlab.utils.tables import json_value

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.frames import Frame
    from mjlab.managers import ObservationTermCfg


@dataclass(frozen=True)
class Measurement:
    """Raw value that a robot must supply."""

    name: str
    """Name in the contract."""
    shape: tuple[int, ...]
    """Shape of one value."""
    unit: str
    """Unit."""
    frame: str
    """Frame that the value is expressed in; empty for joints and images."""
    availability: Availability
    """Origin on a robot."""
    why: str
    """Reason of the availability, in words."""
    source: dict[str, Any]
    """Origin in plain MuJoCo; the page of the contract has the kinds."""
    read: Callable[[ManagerBasedRlEnv], torch.Tensor] | None
    """Return the value in all environments, (N, *shape). None: it is that of `term`."""
    term: ObservationTermCfg | None = None
    """Observation term that the value is that of; reading it again would advance terms with state."""

    def entry(self) -> dict[str, Any]:
        """Return the entry of the contract."""
        size = 1
        for count in self.shape:
            size *= count
        return {
            "name": self.name,
            "size": size,
            "shape": list(self.shape),
            "unit": self.unit,
            "frame": self.frame,
            "availability": self.availability,
            "why": self.why,
            "source": self.source,
            "is_quaternion": "quat" in f"{self.source['kind']} {self.source.get('type', '')}",
        }


@dataclass(frozen=True)
class Subject:
    """Environment, and the entity that the contract calls the robot."""

    env: ManagerBasedRlEnv
    """Environment."""
    robot: str
    """Name of the entity."""

    @property
    def entity(self) -> Entity:
        """Entity of the robot."""
        return self.env.scene[self.robot]

    @property
    def is_fixed(self) -> bool:
        """True if the base of the robot does not move."""
        entity = self.env.scene.entities.get(self.robot)
        return entity is not None and entity.is_fixed_base

    @property
    def model(self) -> mujoco.MjModel:
        """Compiled model of the scene."""
        return self.env.sim.mj_model

    def name(self, entity: str, text: str) -> str:
        """Return the name of a measurement: those of other entities begin with the entity's name."""
        return text if entity == self.robot else f"{entity}_{text}"


# Joints.


def joint_unit(entity: Entity) -> str:
    """Return the unit of the joint positions of an entity."""
    slides = {joint.type == mujoco.mjtJoint.mjJNT_SLIDE for joint in entity.joints}
    return {(True,): "m", (False,): "rad"}.get(tuple(slides), "rad or m")


def joint_pos(subject: Subject, entity_name: str) -> Measurement:
    """Positions of all joints, in the entity's order, as the encoders read them."""
    return _of_joints(subject, entity_name, "joint_pos", "")


def joint_vel(subject: Subject, entity_name: str) -> Measurement:
    """Velocities of all joints, in the entity's order."""
    return _of_joints(subject, entity_name, "joint_vel", "/s")


def _of_joints(subject: Subject, entity_name: str, kind: str, per: str) -> Measurement:
    entity: Entity = subject.env.scene[entity_name]
    is_robot = entity_name == subject.robot
    return Measurement(
        subject.name(entity_name, kind),
        (entity.num_joints,),
        joint_unit(entity) + per,
        "",
        *(availability.ENCODERS if is_robot else availability.OBJECT),
        {"kind": kind, "joints": scene_joints(subject, entity)},
        lambda env: getattr(env.scene[entity_name].data, kind),
    )


def scene_joints(subject: Subject, entity: Entity) -> list[str]:
    """Return the names of an entity's joints in the scene."""
    return [subject.model.joint(i).name for i in entity.indexing.joint_ids.tolist()]


# Root and bodies.


def root_quat(subject: Subject, entity_name: str) -> Measurement:
    """Orientation of the root, quaternion (w, x, y, z)."""
    return Measurement(
        subject.name(entity_name, "root_quat"),
        (4,),
        "",
        "world",
        *_of_root(subject, entity_name, availability.IMU),
        {"kind": "body_quat", "body": _root(subject, entity_name)},
        lambda env: env.scene[entity_name].data.root_link_quat_w,
    )


def root_pos(subject: Subject, entity_name: str) -> Measurement:
    """Position of the root."""
    return Measurement(
        subject.name(entity_name, "root_pos"),
        (3,),
        "m",
        "world",
        *_of_root(subject, entity_name, availability.POSITION),
        {"kind": "body_pos", "body": _root(subject, entity_name)},
        lambda env: env.scene[entity_name].data.root_link_pos_w,
    )


def root_lin_vel_b(subject: Subject, entity_name: str) -> Measurement:
    """Linear velocity of the root's origin, in the root frame."""
    return Measurement(
        subject.name(entity_name, "root_lin_vel_b"),
        (3,),
        "m/s",
        "root",
        *_of_root(subject, entity_name, availability.VELOCITY),
        {"kind": "body_lin_vel_b", "body": _root(subject, entity_name)},
        lambda env: env.scene[entity_name].data.root_link_lin_vel_b,
    )


def root_ang_vel_b(subject: Subject, entity_name: str) -> Measurement:
    """Angular velocity of the root, in the root frame."""
    return Measurement(
        subject.name(entity_name, "root_ang_vel_b"),
        (3,),
        "rad/s",
        "root",
        *_of_root(subject, entity_name, availability.GYROSCOPE),
        {"kind": "body_ang_vel_b", "body": _root(subject, entity_name)},
        lambda env: env.scene[entity_name].data.root_link_ang_vel_b,
    )


def body_quat(subject: Subject, entity_name: str, body: str) -> Measurement:
    """Orientation of a body, quaternion (w, x, y, z)."""
    if body == _root(subject, entity_name).rpartition("/")[2]:
        return root_quat(subject, entity_name)
    index = subject.env.scene[entity_name].body_names.index(body)
    return Measurement(
        subject.name(entity_name, f"{body}_quat"),
        (4,),
        "",
        "world",
        *_of_orientation(subject, entity_name),
        {"kind": "body_quat", "body": _full(subject, entity_name, body)},
        lambda env: env.scene[entity_name].data.body_link_quat_w[:, index],
    )


def body_pos(subject: Subject, entity_name: str, body: str) -> Measurement:
    """Position of a body's origin in the world."""
    if body == _root(subject, entity_name).rpartition("/")[2]:
        return root_pos(subject, entity_name)
    entity: Entity = subject.env.scene[entity_name]
    index = entity.body_names.index(body)
    return Measurement(
        subject.name(entity_name, f"{body}_pos"),
        (3,),
        "m",
        "world",
        *_of_pose(subject, entity_name, availability.POSITION),
        {"kind": "body_pos", "body": _full(subject, entity_name, body)},
        lambda env: env.scene[entity_name].data.body_link_pos_w[:, index],
    )


# Sites and other frames.


def site_pos(subject: Subject, entity_name: str, site: str) -> Measurement:
    """Position of a site in the world."""
    index = subject.env.scene[entity_name].site_names.index(site)
    return Measurement(
        subject.name(entity_name, f"{site}_pos"),
        (3,),
        "m",
        "world",
        *_of_pose(subject, entity_name, availability.POSITION),
        {"kind": "site_pos", "site": _full(subject, entity_name, site)},
        lambda env: env.scene[entity_name].data.site_pos_w[:, index],
    )


def site_quat(subject: Subject, entity_name: str, site: str) -> Measurement:
    """Orientation of a site, quaternion (w, x, y, z)."""
    index = subject.env.scene[entity_name].site_names.index(site)
    return Measurement(
        subject.name(entity_name, f"{site}_quat"),
        (4,),
        "",
        "world",
        *_of_orientation(subject, entity_name),
        {"kind": "site_quat", "site": _full(subject, entity_name, site)},
        lambda env: env.scene[entity_name].data.site_quat_w[:, index],
    )


def site_lin_vel_w(subject: Subject, entity_name: str, site: str) -> Measurement:
    """Linear velocity of a site, world axes."""
    index = subject.env.scene[entity_name].site_names.index(site)
    return Measurement(
        subject.name(entity_name, f"{site}_lin_vel_w"),
        (3,),
        "m/s",
        "world",
        *_of_pose(subject, entity_name, availability.VELOCITY),
        {"kind": "site_lin_vel_w", "site": _full(subject, entity_name, site)},
        lambda env: env.scene[entity_name].data.site_lin_vel_w[:, index],
    )


def frame_pose_b(
    subject: Subject, entity_name: str, frame: Frame
) -> tuple[Measurement, Measurement]:
    """Position and orientation of a frame of an entity, in the entity's root frame."""
    full = getattr(subject.model, frame.frame_type)(frame.element).name
    source = {"type": frame.frame_type, "name": full, "root": _root(subject, entity_name)}

    def pose(env: ManagerBasedRlEnv) -> tuple[torch.Tensor, torch.Tensor]:
        root = env.scene[entity_name].data
        return subtract_frame_transforms(
            root.root_link_pos_w, root.root_link_quat_w, frame.pos, frame.quat
        )

    name = subject.name(entity_name, full.rpartition("/")[2])
    return (
        Measurement(
            f"{name}_pos_b",
            (3,),
            "m",
            "root",
            *_of_orientation(subject, entity_name),
            {"kind": "frame_pos_b", **source},
            lambda env: pose(env)[0],
        ),
        Measurement(
            f"{name}_quat_b",
            (4,),
            "",
            "root",
            *_of_orientation(subject, entity_name),
            {"kind": "frame_quat_b", **source},
            lambda env: pose(env)[1],
        ),
    )


# Sensors.

_UNITS = {
    "gyro": "rad/s",
    "velocimeter": "m/s",
    "accelerometer": "m/s^2",
    "force": "N",
    "torque": "N m",
    "framequat": "",
    "framepos": "m",
    "framelinvel": "m/s",
    "frameangvel": "rad/s",
    "jointpos": "rad or m",
    "jointvel": "rad/s or m/s",
    "touch": "N",
}


def sensor(subject: Subject, sensor_name: str) -> Measurement:
    """Value of a MuJoCo sensor, in MuJoCo's unit and frame."""
    model = subject.model
    element = model.sensor(sensor_name)
    kind = mujoco.mjtSensor(int(element.type[0])).name.removeprefix("mjSENS_").lower()
    source: dict[str, Any] = {"kind": "sensor", "sensor": sensor_name, "type": kind}
    objtype, index = int(element.objtype[0]), int(element.objid[0])
    if body := _body_of(model, objtype, index):
        source["body"] = body
    frame = "world"
    if objtype == int(mujoco.mjtObj.mjOBJ_SITE):
        source |= {
            "site": model.site(index).name,
            "site_pos": model.site_pos[index].tolist(),
            "site_quat": model.site_quat[index].tolist(),
        }
        if not kind.startswith("frame"):
            frame = f"site {model.site(index).name}"
    reftype, reference = int(element.reftype[0]), int(element.refid[0])
    if reference >= 0:
        word = mujoco.mjtObj(reftype).name.removeprefix("mjOBJ_").lower().removeprefix("x")
        frame = f"{word} {getattr(model, word)(reference).name}"
    entity, _, short = sensor_name.rpartition("/")
    bodies = (body, _body_of(model, reftype, reference))
    owners = [one.rpartition("/")[0] for one in bodies if "/" in one]
    is_own = {*(owners or [entity])} <= {"", subject.robot}
    is_relative = owners == [subject.robot] * 2 or subject.is_fixed
    return Measurement(
        subject.name(entity or subject.robot, short),
        (int(element.dim[0]),),
        _UNITS.get(kind, ""),
        frame,
        *availability.of_sensor(kind, is_own, is_relative),
        source,
        lambda env: env.scene[sensor_name].data,
    )


def _body_of(model: mujoco.MjModel, objtype: int, index: int) -> str:
    """Return the name of the body of a sensor's object; empty for objects without one."""
    kinds = mujoco.mjtObj
    bodies = {
        kinds.mjOBJ_SITE: model.site_bodyid,
        kinds.mjOBJ_GEOM: model.geom_bodyid,
        kinds.mjOBJ_CAMERA: model.cam_bodyid,
        kinds.mjOBJ_BODY: range(model.nbody),
        kinds.mjOBJ_XBODY: range(model.nbody),
    }.get(mujoco.mjtObj(objtype))
    return "" if index < 0 or bodies is None else model.body(int(bodies[index])).name


def traced(
    subject: Subject,
    name: str,
    unit: str,
    reason: Reason,
    cfg: ObservationTermCfg,
) -> Measurement:
    """Value of a term that no kinematics gives, such as scans, images and contacts."""
    source = {
        "kind": "trace",
        "function": name_of(cfg.func),
        "params": plain(dict(cfg.params)),
    }
    shape = shape_of(subject.env, cfg)
    return Measurement(name, shape, unit, "", *reason, source, None, cfg)


def shape_of(env: ManagerBasedRlEnv, cfg: ObservationTermCfg) -> tuple[int, ...]:
    """Return the shape of one value of a term, without history; its state does not advance."""
    parts = [cfg.func] if is_stateful(cfg.func) else []
    with preserved_rng(), changes_undone(parts):
        return tuple(cfg.func(env, **cfg.params).shape[1:])


def name_of(func: Any) -> str:
    """Return `module:name` of a term's function, or of the class of a term with state."""
    func = func if hasattr(func, "__qualname__") else type(func)
    return f"{func.__module__}:{func.__qualname__}"


def plain(value: Any) -> Any:
    """Return `value` for JSON, without infinities."""
    value = json_value(value)
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# Shared.


def _root(subject: Subject, entity_name: str) -> str:
    entity: Entity = subject.env.scene[entity_name]
    return subject.model.body(int(entity.indexing.root_body_id)).name


def _full(subject: Subject, entity_name: str, name: str) -> str:
    return f"{entity_name}/{name}"


def _of_root(subject: Subject, entity_name: str, reason: Reason) -> Reason:
    """Return the availability of a quantity of the root: `reason` for a robot that moves freely."""
    if entity_name != subject.robot:
        return availability.OBJECT
    return availability.FIXED_BASE if subject.is_fixed else reason


def _of_pose(subject: Subject, entity_name: str, reason: Reason) -> Reason:
    """Return the availability of a quantity of a body or site: `reason` for a robot that moves freely."""
    if entity_name != subject.robot:
        return availability.OBJECT
    return availability.KINEMATICS if subject.is_fixed else reason


def _of_orientation(subject: Subject, entity_name: str) -> Reason:
    """Return the availability of the orientation of a body or site, or of its pose in the root frame."""
    return _of_pose(subject, entity_name, availability.KINEMATICS)
