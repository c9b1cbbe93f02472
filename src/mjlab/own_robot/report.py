"""Values of a task for a robot, each with its reason, and the questions that remain."""

from __future__ import annotations

import re
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, find_anatomy
from mjlab.own_robot.gains import effort_limits, find_gains, rotor_inertias
from mjlab.own_robot.guess import Guess, Question
from mjlab.own_robot.model_source import RobotModel, load_model, name_elements
from mjlab.own_robot.posture import Posture, find_posture
from mjlab.own_robot.reach import arm_home
from mjlab.utils.errors import UnknownNameError
from mjlab.utils.string import suggest

PER_JOINT = ("pose", "effort", "armature", "stiffness", "damping", "action_scale")
"""Settings of one joint (`effort.FL_knee`), joints by pattern, or all joints (`effort`)."""
SETTINGS = ("kind", "floating_base", "root_height", *PER_JOINT)
"""Names of settings."""


@dataclass(frozen=True)
class RobotReport:
    """A robot, as far as its model file tells."""

    model: RobotModel
    """Model as the file has it."""
    spec: mujoco.MjSpec
    """Copy of the spec with all bodies, joints and geoms named; names below are of this spec."""
    compiled: mujoco.MjModel
    """`spec`, compiled."""
    anatomy: Anatomy
    posture: Posture | None
    """Standing pose; None but for legged robots."""
    joint_pos: Guess[dict[str, float]]
    """Initial position of each joint (rad, m)."""
    root_height: Guess[float]
    """Initial height of the trunk or base (m)."""
    effort: Guess[dict[str, float]]
    """Effort limit of each joint (N m, N)."""
    armature: Guess[dict[str, float]]
    """Rotor inertia times squared gear ratio of each joint (kg m^2, kg)."""
    stiffness: Guess[dict[str, float]]
    """Stiffness of each joint's position servo (N m/rad, N/m)."""
    damping: Guess[dict[str, float]]
    """Damping of each joint's position servo (N m s/rad, N s/m)."""
    action_scale: Guess[dict[str, float]]
    """Change of a joint's target by a unit action (rad, m)."""
    pose_tolerance: Guess[dict[str, float]]
    """Deviation of each joint from the initial pose that walking needs (rad)."""
    commands: Guess[dict[str, tuple[float, float]]]
    """Ranges of velocity commands (`lin_vel_x`, `lin_vel_y` in m/s, `ang_vel_z` in rad/s)."""
    questions: tuple[Question, ...]


def describe_robot(source: str | RobotModel, settings: dict[str, str] | None = None) -> RobotReport:
    """Return the values of a task for a robot.

    Args:
        source: Model, or source of one as of `load_model`.
        settings: Answers by setting: a name of `SETTINGS`, for those of joints followed by a dot and
            a joint or pattern: `{"armature": "0.01", "pose.FL_knee": "-1.8"}`.

    Raises:
        UnknownNameError: unknown setting, or a pattern that matches no joint.
    """
    settings = settings or {}
    for key in settings:
        if key.partition(".")[0] not in SETTINGS:
            raise UnknownNameError(f"Unknown setting {key!r}; {suggest(key, SETTINGS)}")
    if isinstance(source, str):
        floating = settings.get("floating_base", "false").lower() in ("true", "1", "yes")
        model = load_model(source, floating_base=floating)
    else:
        model = source
    spec = model.spec.copy()
    name_elements(spec)
    compiled = spec.compile()
    anatomy = find_anatomy(compiled, kind=settings.get("kind"))  # ty: ignore[invalid-argument-type]
    questions: list[Question] = []
    if model.is_urdf and geo.free_joint(compiled) is None and "floating_base" not in settings:
        text = "a URDF has no free joint: true for a robot with legs or wheels, false for an arm"
        questions.append(Question("floating_base", text, "false"))
    answers = {name: _answers(name, settings, compiled) for name in PER_JOINT}
    posture = None
    if anatomy.kind.value == "legged":
        posture = find_posture(compiled, anatomy, answers["pose"])
        joint_pos, height = posture.joint_pos, posture.root_height
        questions += posture.questions
        size = height.value
        if anatomy.imu_site.source == "asked":
            text = "site of the IMU: no gyro and no site named imu"
            questions.append(Question("imu_site", text, "the trunk's origin"))
        if anatomy.front.value < 0.0:
            text = "front of the robot: the toes point along -x, the task's forward is x"
            questions.append(Question("front", text, "x, so that it walks backward"))
    else:
        joint_pos, asked = arm_home(compiled, anatomy, answers["pose"])
        questions += asked
        height = _mount_height(compiled, anatomy, joint_pos.value)
        size = _reach(compiled)
    if "root_height" in settings:
        height = Guess(float(settings["root_height"]), "as set", "set")
    effort, asked = effort_limits(compiled, size, _main_joints(anatomy), answers["effort"])
    questions += asked
    is_arm = anatomy.kind.value == "arm"
    armature, asked = rotor_inertias(compiled, effort.value, is_arm, answers["armature"])
    questions += asked
    stiffness, damping = find_gains(
        spec,
        compiled,
        anatomy,
        joint_pos.value,
        height.value,
        effort.value,
        armature.value,
        answers["stiffness"],
    )
    if answers["damping"]:
        damping = Guess(damping.value | answers["damping"], "as set", "set")
    scale = _action_scale(compiled, is_arm, effort.value, stiffness.value)
    if answers["action_scale"]:
        scale = Guess(scale.value | answers["action_scale"], "as set", "set")
    return RobotReport(
        model=model,
        spec=spec,
        compiled=compiled,
        anatomy=anatomy,
        posture=posture,
        joint_pos=joint_pos,
        root_height=height,
        effort=effort,
        armature=armature,
        stiffness=stiffness,
        damping=damping,
        action_scale=scale,
        pose_tolerance=_pose_tolerance(compiled, anatomy),
        commands=command_ranges(height.value, len(anatomy.feet.value)),
        questions=tuple(questions),
    )


def _answers(name: str, settings: dict[str, str], model: mujoco.MjModel) -> dict[str, float]:
    """Return the answers to a setting by joint.

    Raises:
        UnknownNameError: a pattern matches no joint.
    """
    joints = [model.joint(j).name for j in geo.joint_ids(model)]
    answers: dict[str, float] = {}
    for key, value in settings.items():
        setting, _, pattern = key.partition(".")
        if setting != name:
            continue
        matches = [joint for joint in joints if re.fullmatch(pattern or ".*", joint)]
        if not matches:
            raise UnknownNameError(f"Setting {key!r}: no such joint; {suggest(pattern, joints)}")
        answers |= dict.fromkeys(matches, float(value))
    return answers


def _main_joints(anatomy: Anatomy) -> tuple[str, ...]:
    """Return the joints of the legs, of an arm those of its first hand."""
    if anatomy.kind.value == "arm":
        return anatomy.hands.value[0].joints
    return anatomy.leg_joints


def command_ranges(height: float, feet: int) -> Guess[dict[str, tuple[float, float]]]:
    """Return the ranges of velocity commands: speeds of equal Froude number v^2 / (g h).

    The Go1 (trunk at 0.28 m) is commanded 1 m/s, the G1 (0.76 m) too.
    """
    reference = 0.76 if feet == 2 else 0.28
    speed = float(np.sqrt(max(height, 1e-3) / reference))
    turn = 0.5 / speed
    ranges = {
        "lin_vel_x": (-speed, speed),
        "lin_vel_y": (-speed, speed),
        "ang_vel_z": (-turn, turn),
    }
    rule = (
        f"1 m/s x sqrt(height / {reference} m): Froude number of the {'G1' if feet == 2 else 'Go1'}"
    )
    return Guess(ranges, rule)


def _action_scale(
    model: mujoco.MjModel, is_arm: bool, effort: dict[str, float], stiffness: dict[str, float]
) -> Guess[dict[str, float]]:
    if is_arm:
        ranges = {n: geo.joint_range(model, model.joint(n).id) for n in effort}
        scale = {n: 0.125 * (high - low) for n, (low, high) in ranges.items()}
        return Guess(scale, "a quarter of half the range")
    scale = {n: float(np.clip(0.25 * effort[n] / stiffness[n], 0.2, 0.5)) for n in effort}
    return Guess(scale, "0.25 x effort / stiffness, between 0.2 and 0.5 rad")


def _pose_tolerance(model: mujoco.MjModel, anatomy: Anatomy) -> Guess[dict[str, float]]:
    tolerance = {model.joint(j).name: 0.3 for j in geo.joint_ids(model)}
    return Guess(tolerance, "0.3 rad")


def _mount_height(
    model: mujoco.MjModel, anatomy: Anatomy, joint_pos: dict[str, float]
) -> Guess[float]:
    data = mujoco.MjData(model)
    geo.set_pose(model, data, joint_pos)
    geoms = [model.geom(name).id for name in anatomy.colliding.value]
    lowest = geo.lowest_height(model, data, geoms)
    if lowest < -0.02:
        return Guess(-lowest, "on a stand: the arm hangs below its base")
    return Guess(0.0, "base on the ground")


def _reach(model: mujoco.MjModel) -> float:
    """Return the greatest extent of a robot without feet (m): lengths of its links in a row."""
    lengths = np.linalg.norm(model.body_pos, axis=1)
    reach = np.zeros(model.nbody)
    for body in range(1, model.nbody):
        reach[body] = reach[model.body_parentid[body]] + lengths[body]
    return float(reach.max(initial=0.1))
