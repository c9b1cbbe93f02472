"""Values of a task for a robot, each with its reason, and the questions that remain."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, find_anatomy, fixed_legs, like_joints
from mjlab.own_robot.gains import find_efforts, find_gains, rotor_inertias
from mjlab.own_robot.gait import command_ranges, pose_tolerance
from mjlab.own_robot.guess import Guess, JointGuess, Question
from mjlab.own_robot.model_source import RobotModel, load_model, name_elements
from mjlab.own_robot.posture import Posture, find_posture
from mjlab.own_robot.reach import arm_home, stand_height
from mjlab.own_robot.settings import PER_JOINT, Answers, parse_settings


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
    joint_pos: JointGuess
    """Initial position of each joint (rad, m)."""
    root_height: Guess[float]
    """Initial height of the trunk or base (m)."""
    effort: JointGuess
    """Effort limit of each joint (N m, N)."""
    armature: JointGuess
    """Rotor inertia times squared gear ratio of each joint (kg m^2, kg)."""
    stiffness: JointGuess
    """Stiffness of each joint's position servo (N m/rad, N/m)."""
    damping: JointGuess
    """Damping of each joint's position servo (N m s/rad, N s/m)."""
    action_scale: JointGuess
    """Change of a joint's target by a unit action (rad, m)."""
    pose_tolerance: JointGuess
    """Deviation of each joint from the initial pose that walking needs (rad)."""
    commands: Guess[dict[str, tuple[float, float]]]
    """Ranges of velocity commands (`lin_vel_x`, `lin_vel_y` in m/s, `ang_vel_z` in rad/s)."""
    answers: dict[str, dict[str, float]]
    """Answers of the user by setting of `PER_JOINT`, and by joint."""
    questions: tuple[Question, ...]


def describe_robot(source: str | RobotModel, settings: dict[str, str] | None = None) -> RobotReport:
    """Return the values of a task for a robot.

    Args:
        source: Model, or source of one as of `load_model`.
        settings: Answers by setting: a name of `settings.SETTINGS`, for those of joints followed by a dot and
            a joint or pattern: `{"armature": "0.01", "pose.FL_knee": "-1.8"}`.

    Raises:
        UnknownNameError: unknown setting, or a pattern that matches no joint.
        ValueError: setting with a value that it does not have.
    """
    given = parse_settings(settings or {})
    questions: list[Question] = []
    model = load_model(source) if isinstance(source, str) else source
    spec = model.spec.copy()
    name_elements(spec)
    compiled = spec.compile()
    if _is_floating(model, compiled, given, questions):
        compiled = _add_free_joint(spec, compiled)
    anatomy = _find_anatomy(compiled, given, questions)
    joints = [compiled.joint(j).name for j in geo.joint_ids(compiled)]
    answers = {name: given.joint_values(name, joints) for name in PER_JOINT}
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
    if given.root_height is not None:
        height = Guess(given.root_height, "as set", "set")
    effort, asked = find_efforts(compiled, size, _main_joints(anatomy), answers["effort"])
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
    scale = _action_scale(compiled, anatomy, effort.value, stiffness.value, answers)
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
        damping=damping.answered(answers["damping"]),
        action_scale=scale.answered(answers["action_scale"]),
        pose_tolerance=pose_tolerance(compiled, anatomy, pose, height.value),
        commands=commands if legged else Guess({}, "no legs"),
        answers=answers,
        questions=tuple(questions),
    )


def _is_floating(
    model: RobotModel, compiled: mujoco.MjModel, given: Answers, questions: list[Question]
) -> bool:
    """Return True if the robot needs a free joint that its file does not have; ask if it may."""
    if any(joint.type == geo.FREE for joint in model.spec.joints):
        if given.floating_base is False:
            raise ValueError("Setting floating_base=false: the model file has a free joint.")
        return False
    if given.kind == "legged" and given.floating_base is False:
        raise ValueError("Setting kind=legged: expected floating_base=true, got false.")
    if given.floating_base is not None or given.kind == "legged":
        return given.floating_base is not False
    named = [j.name for j in model.spec.joints if re.search(_LEG_NAMES, j.name.lower())]
    legs = fixed_legs(compiled)
    if not model.is_urdf and legs < 2:
        return False
    text = "the file has no free joint: true for a robot with legs or wheels, false for an arm"
    reason = (
        f"true, because of joint {named[0]!r}" if named else "false, no joint is named like a leg's"
    )
    questions.append(Question("floating_base", text, reason))
    return bool(named)


_LEG_NAMES = "hip|knee|ankle|calf|thigh|(?<![a-z])(haa|hfe|kfe)(?![a-z])"


def _add_free_joint(spec: mujoco.MjSpec, fixed: mujoco.MjModel) -> mujoco.MjModel:
    """Let the trunk of a robot with a fixed base float, and compile it; keyframes start in its place."""
    body = fixed.body(find_anatomy(fixed).trunk.value).id
    spec.bodies[body].add_freejoint()
    for key in spec.keys:
        key.qpos = [*fixed.body_pos[body], *fixed.body_quat[body], *fixed.key_qpos[key.id]]
        key.qvel = [0.0] * (fixed.nv + 6)
    name_elements(spec)
    return spec.compile()


def _find_anatomy(compiled: mujoco.MjModel, given: Answers, questions: list[Question]) -> Anatomy:
    """Return the parts of the robot with answers, and ask what is doubtful."""
    anatomy = find_anatomy(compiled, kind=given.kind)
    kind = anatomy.kind.value
    for needing, parts, what in (
        ("legged", anatomy.feet.value, "2, 4 or 6 ends that are lowest in a standing pose"),
        ("arm", anatomy.hands.value, "an arm of three or more joints"),
    ):
        if kind == needing and not parts:
            raise ValueError(f"Setting kind={kind}: expected {what}, found none.")
    for name, answer in (("front", given.front), ("imu_site", given.imu_site)):
        if answer is not None and kind != "legged":
            raise ValueError(f"Setting {name}: expected a robot of kind legged, found {kind}.")
    if given.imu_site is not None:
        imu = _answered_imu(compiled, anatomy, given.imu_site)
        anatomy = dataclasses.replace(anatomy, imu_site=imu)
    elif kind == "legged" and anatomy.imu_site.source == "asked":
        text = "site of the IMU: no gyro and no site named imu"
        questions.append(Question("imu_site", text, "trunk, its origin"))
    if given.front is not None:
        anatomy = dataclasses.replace(anatomy, front=Guess(given.front, "as set", "set"))
    elif anatomy.front.source == "asked":
        text = (
            "front of the robot: the toes point along -x of the trunk, and forward of the task is x"
        )
        questions.append(Question("front", text, "-x"))
    return anatomy


def _answered_imu(compiled: mujoco.MjModel, anatomy: Anatomy, site: str) -> Guess[str | None]:
    """Return the answer to the IMU's site, which mirror images expect on the trunk with its axes.

    Raises:
        ValueError: no such site.
    """
    trunk = compiled.body(anatomy.trunk.value).id
    sites = [
        compiled.site(i).name
        for i in range(compiled.nsite)
        if compiled.site_bodyid[i] == trunk and abs(abs(compiled.site_quat[i, 0]) - 1.0) < 1e-6
    ]
    if site not in ("trunk", *sites):
        raise ValueError(
            f"Setting imu_site={site}: expected a site on the trunk, {anatomy.trunk.value!r}, with its "
            f"axes: one of {['trunk', *sites]}; trunk is its origin."
        )
    return Guess(None if site == "trunk" else site, "as set", "set")


def _main_joints(anatomy: Anatomy) -> tuple[str, ...]:
    """Return the joints of the legs, of an arm those of its first hand."""
    if anatomy.kind.value == "arm":
        return anatomy.hands.value[0].joints
    return anatomy.leg_joints


def _action_scale(
    model: mujoco.MjModel,
    anatomy: Anatomy,
    effort: dict[str, float],
    stiffness: dict[str, float],
    answers: dict[str, dict[str, float]],
) -> JointGuess:
    if anatomy.kind.value == "arm":
        ranges = {n: geo.joint_range(model, model.joint(n).id) for n in effort}
        # As the YAM's, with which 0.25 million steps teach three times as much as with half of it.
        scale = {n: min(0.25 * (high - low), 1.5) for n, (low, high) in ranges.items()}
        rule = "a quarter of the range, at most 1.5 rad"
    else:
        scale = {n: float(np.clip(0.25 * effort[n] / stiffness[n], 0.2, 0.5)) for n in effort}
        rule = "0.25 x effort limit / stiffness, between 0.2 and 0.5 rad"
    of_joint = {n: (answers["effort"].get(n), answers["stiffness"].get(n)) for n in effort}
    return JointGuess.of(scale, rule).alike(like_joints(anatomy, effort, of_joint))


def _reach(model: mujoco.MjModel) -> float:
    """Return the greatest extent of a robot without feet (m): lengths of its links in a row."""
    lengths = np.linalg.norm(model.body_pos, axis=1)
    reach = np.zeros(model.nbody)
    for body in range(1, model.nbody):
        reach[body] = reach[model.body_parentid[body]] + lengths[body]
    return float(reach.max(initial=0.1))
