"""Values of a task for a robot, each with its reason, and the questions that remain."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from typing import cast, get_args

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, Kind, find_anatomy
from mjlab.own_robot.gains import effort_limits, find_gains, rotor_inertias
from mjlab.own_robot.gait import command_ranges, pose_tolerance
from mjlab.own_robot.guess import Guess, Question
from mjlab.own_robot.model_source import RobotModel, load_model, name_elements
from mjlab.own_robot.posture import Posture, find_posture
from mjlab.own_robot.reach import arm_home, stand_height
from mjlab.utils.errors import UnknownNameError, check_one_of
from mjlab.utils.string import suggest

PER_JOINT = ("pose", "effort", "armature", "stiffness", "damping", "action_scale")
"""Settings of one joint (`effort.FL_knee`), joints by pattern, or all joints (`effort`)."""
SETTINGS = ("kind", "floating_base", "front", "imu_site", "root_height", *PER_JOINT)
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
        ValueError: setting with a value that it does not have.
    """
    settings = settings or {}
    for key in settings:
        if key.partition(".")[0] not in SETTINGS:
            raise UnknownNameError(f"Unknown setting {key!r}; {suggest(key, SETTINGS)}")
    questions: list[Question] = []
    model = _load(source, settings, questions) if isinstance(source, str) else source
    spec = model.spec.copy()
    name_elements(spec)
    compiled = spec.compile()
    anatomy = _find_anatomy(compiled, settings, questions)
    answers = {name: _answers(name, settings, compiled) for name in PER_JOINT}
    legged, is_arm = anatomy.kind.value == "legged", anatomy.kind.value == "arm"
    posture = find_posture(compiled, anatomy, answers["pose"]) if legged else None
    if posture is not None:
        joint_pos, height, size = posture.joint_pos, posture.root_height, posture.root_height.value
        questions += posture.questions
    else:
        joint_pos, asked = arm_home(compiled, anatomy, answers["pose"])
        questions += asked
        stand = stand_height(compiled, anatomy)
        height = Guess(stand, "on a stand: the arm hangs" if stand else "base on the ground")
        size = _reach(compiled)
    if "root_height" in settings:
        height = Guess(float(settings["root_height"]), "as set", "set")
    effort, asked = effort_limits(compiled, size, _main_joints(anatomy), answers["effort"])
    questions += asked
    armature, asked = rotor_inertias(compiled, effort.value, is_arm, answers["armature"])
    questions += asked
    pose = joint_pos.value
    stiffness, damping, asked = find_gains(
        spec,
        compiled,
        anatomy,
        pose,
        height.value,
        effort.value,
        armature.value,
        answers["stiffness"],
    )
    questions += asked
    scale = _action_scale(compiled, is_arm, effort.value, stiffness.value)
    commands = command_ranges(height.value, len(anatomy.feet.value))
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
        damping=_answered(damping, answers["damping"]),
        action_scale=_answered(scale, answers["action_scale"]),
        pose_tolerance=pose_tolerance(compiled, anatomy, pose, height.value),
        commands=commands if legged else Guess({}, "no legs"),
        questions=tuple(questions),
    )


def _load(source: str, settings: dict[str, str], questions: list[Question]) -> RobotModel:
    """Return the model of a source; of a URDF with the free joint that its names of joints suggest."""
    if "floating_base" in settings:
        floating = settings["floating_base"].lower() in ("true", "1", "yes")
        return load_model(source, floating_base=floating)
    model = load_model(source)
    if not model.is_urdf or any(joint.type == geo.FREE for joint in model.spec.joints):
        return model
    legs = [
        j.name for j in model.spec.joints if re.search("hip|knee|ankle|calf|thigh", j.name.lower())
    ]
    text = "a URDF has no free joint: true for a robot with legs or wheels, false for an arm"
    reason = (
        f"true, because of joint {legs[0]!r}" if legs else "false, no joint is named like a leg's"
    )
    questions.append(Question("floating_base", text, reason))
    return load_model(source, floating_base=True) if legs else model


def _find_anatomy(
    compiled: mujoco.MjModel, settings: dict[str, str], questions: list[Question]
) -> Anatomy:
    """Return the parts of the robot with answers, and ask what is doubtful."""
    kind = settings.get("kind")
    if kind is not None:
        check_one_of("Setting kind", kind, get_args(Kind))
    anatomy = find_anatomy(compiled, kind=cast("Kind | None", kind))
    if "imu_site" in settings:
        site = settings["imu_site"]
        sites = [compiled.site(i).name for i in range(compiled.nsite)]
        check_one_of("Setting imu_site", site, ["trunk", *sites])
        guess: Guess[str | None] = Guess(None if site == "trunk" else site, "as set", "set")
        anatomy = dataclasses.replace(anatomy, imu_site=guess)
    elif anatomy.kind.value == "legged" and anatomy.imu_site.source == "asked":
        text = "site of the IMU: no gyro and no site named imu"
        questions.append(Question("imu_site", text, "trunk, its origin"))
    if "front" in settings:
        check_one_of("Setting front", settings["front"], ["x", "-x"])
        front = Guess(1.0 if settings["front"] == "x" else -1.0, "as set", "set")
        anatomy = dataclasses.replace(anatomy, front=front)
    elif anatomy.front.source == "asked":
        text = (
            "front of the robot: the toes point along -x of the trunk, and forward of the task is x"
        )
        questions.append(Question("front", text, "-x"))
    return anatomy


def _answered(guess: Guess[dict[str, float]], answers: dict[str, float]) -> Guess[dict[str, float]]:
    return Guess(guess.value | answers, "as set", "set") if answers else guess


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


def _action_scale(
    model: mujoco.MjModel, is_arm: bool, effort: dict[str, float], stiffness: dict[str, float]
) -> Guess[dict[str, float]]:
    if is_arm:
        ranges = {n: geo.joint_range(model, model.joint(n).id) for n in effort}
        # As the YAM's, with which 0.25 million steps teach three times as much as with half of it.
        scale = {n: min(0.25 * (high - low), 1.5) for n, (low, high) in ranges.items()}
        return Guess(scale, "a quarter of the range, at most 1.5 rad")
    scale = {n: float(np.clip(0.25 * effort[n] / stiffness[n], 0.2, 0.5)) for n in effort}
    return Guess(scale, "0.25 x effort / stiffness, between 0.2 and 0.5 rad")


def _reach(model: mujoco.MjModel) -> float:
    """Return the greatest extent of a robot without feet (m): lengths of its links in a row."""
    lengths = np.linalg.norm(model.body_pos, axis=1)
    reach = np.zeros(model.nbody)
    for body in range(1, model.nbody):
        reach[body] = reach[model.body_parentid[body]] + lengths[body]
    return float(reach.max(initial=0.1))
