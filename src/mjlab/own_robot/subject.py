"""A model to check: as it is simulated, in its initial state, with the places of its elements."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import mujoco

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, actuated_joint, find_anatomy
from mjlab.own_robot.gains import file_effort, servo_stiffness
from mjlab.own_robot.model_source import name_elements
from mjlab.own_robot.source_lines import SourceLines, element_path, shown


@dataclass
class Subject:
    """A model as it is simulated, with its initial state."""

    spec: mujoco.MjSpec
    """Compiled spec with named elements: ids of its elements are those of the model."""
    model: mujoco.MjModel
    """Model."""
    data: mujoco.MjData
    """Initial state, with positions and contacts computed."""
    pose: str
    """Name of the initial state, such as `keyframe 'home'`."""
    pose_place: str
    """Place of the initial state in the file or config."""
    stiffness: dict[str, float]
    """Stiffness of the actuators by joint (N m/rad, N/m)."""
    effort: dict[str, float]
    """Effort limits by joint (N m, N)."""
    driven: frozenset[str]
    """Joints with an actuator."""
    lines: SourceLines | None = None
    """Lines of the model's file. None: elements are named by their path."""
    unnamed: frozenset[str] = frozenset()
    """Names that the file lacks, given by `name_elements`."""
    gain_places: dict[str, str] = field(default_factory=dict)
    """Setting of the gains in a config, by joint. Others: line of the actuator."""
    ray_groups: tuple[int, ...] = (0,)
    """Geom groups that rays toward the terrain see."""
    is_urdf: bool = False
    """True for a URDF, which has no actuators and no initial state."""

    @cached_property
    def anatomy(self) -> Anatomy:
        """Parts of the robot."""
        return find_anatomy(self.model)

    @cached_property
    def joint_pos(self) -> dict[str, float]:
        """Initial position of each hinge and slide (rad, m)."""
        return {
            self.model.joint(j).name: float(self.data.qpos[self.model.jnt_qposadr[j]])
            for j in geo.joint_ids(self.model)
        }

    @property
    def is_upright(self) -> bool:
        """True if the trunk's z axis points up at `qpos0`, as postures and mirror pairs assume."""
        free = geo.free_joint(self.model)
        if free is None:
            return True
        start = self.model.jnt_qposadr[free] + 3
        _, x, y, _ = self.model.qpos0[start : start + 4]
        return bool(x * x + y * y < 0.05)

    def place(self, element: Any) -> str:
        """Return file and line of an element of the spec; its path in the model if it has none."""
        line = None if self.lines is None else self.lines.of(element)
        return element_path(element) if line is None else str(line)

    def tag_place(self, tag: str, attribute: str = "") -> str:
        """Return file and line of an element outside of bodies; the file if it has none."""
        if self.lines is None:
            return tag
        return str(self.lines.of_tag(tag, attribute) or shown(self.lines.path))

    def joint_places(self, joints: Iterable[str]) -> tuple[str, ...]:
        """Return the places of joints."""
        return tuple(self.place(self.spec.joint(name)) for name in joints)

    def body_place(self, body: int) -> str:
        """Return the place of a body."""
        return self.place(self.spec.bodies[body])

    def geom_places(self, geoms: Iterable[int]) -> tuple[str, ...]:
        """Return the places of geoms."""
        return tuple(self.place(self.spec.geoms[g]) for g in geoms)

    def gain_place(self, joint: str) -> str:
        """Return the place of the gains of a joint."""
        if joint in self.gain_places:
            return self.gain_places[joint]
        own = [a for a in self.spec.actuators if a.target == joint]
        return self.place(own[0] if own else self.spec.joint(joint))


def subject_of(spec: mujoco.MjSpec, lines: SourceLines | None = None) -> Subject:
    """Return the model of a file as MuJoCo starts it: in its first keyframe, else at `qpos0`.

    Args:
        spec: Spec of the file. Its unnamed elements get names.
        lines: Lines of the file.
    """
    unnamed = frozenset(name_elements(spec))
    model = spec.compile()
    data = mujoco.MjData(model)
    # `<size nkey>` makes unnamed copies of `qpos0`.
    has_key = model.nkey > 0 and bool(spec.keys[0].name or (model.key_qpos[0] != model.qpos0).any())
    if has_key:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    subject = Subject(
        spec,
        model,
        data,
        pose=f"keyframe {model.key(0).name or 0!r}" if has_key else "qpos0",
        pose_place="",
        stiffness=servo_stiffness(model),
        effort=effort_limits(model),
        driven=driven_joints(model),
        lines=lines,
        unnamed=unnamed,
        is_urdf=lines is not None and lines.root.tag == "robot",
    )
    free = geo.free_joint(model)
    if has_key:
        subject.pose_place = subject.place(spec.keys[0])
    elif free is not None:
        subject.pose_place = subject.body_place(int(model.jnt_bodyid[free]))
    else:
        subject.pose_place = subject.tag_place("robot" if subject.is_urdf else "worldbody")
    return subject


def effort_limits(model: mujoco.MjModel) -> dict[str, float]:
    """Return the effort limit of each joint with one (N m, N)."""
    limits = {model.joint(j).name: file_effort(model, j) for j in geo.joint_ids(model)}
    return {name: limit for name, limit in limits.items() if limit is not None}


def driven_joints(model: mujoco.MjModel) -> frozenset[str]:
    """Return the hinges and slides with an actuator."""
    joints = [actuated_joint(model, actuator) for actuator in range(model.nu)]
    return frozenset(model.joint(j).name for j in joints if j is not None)
