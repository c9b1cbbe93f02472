"""Source of the task file of a written package."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import mujoco
import numpy as np

from mjlab.own_robot import geometry
from mjlab.own_robot.anatomy import Leg
from mjlab.own_robot.gait import lift
from mjlab.own_robot.posture import pitch_joints, sole_points
from mjlab.own_robot.python_text import comment_lines, dict_source, number, tuple_source
from mjlab.own_robot.report import RobotReport
from mjlab.own_robot.robot_source import (
    by_pattern,
    feet_in_model_order,
    foot_contacts,
    joint_reason_lines,
    motor_joints,
    reason_lines,
)
from mjlab.own_robot.templates import template

STANDING_SHARE = 0.65
"""Height of the trunk below which training episodes end, as a share of the standing height."""
SOLVED = {
    2: {"lin_vel_error_share": 0.6, "ang_vel_error_share": 0.9, "failure_rate": 0.2},
    4: {"lin_vel_error_share": 0.4, "ang_vel_error_share": 0.6, "failure_rate": 0.1},
}
"""Errors, as shares of those of a robot that stands still, and failure rate below which training stops, by
number of feet."""
GEAR_FRICTION = 0.02
"""Dry friction of a drive as a share of its effort limit; 0.017 to 0.024 for the motors of the G1."""
FEET_DISTANCE = 0.85
"""Smallest lateral distance of two feet, as a share of that in the initial pose."""
_STOPS = "Training stops at these shares of the errors of a robot that stands still, and this rate of falls."
_PROFILES = {
    2: "from mjlab.tasks.velocity.rl.biped import Biped, cpu_with_stepping\n"
    "from mjlab.tasks.velocity.rl.ppo import velocity_ppo_runner_cfg",
    4: "from mjlab.tasks.velocity.rl.ppo import cpu_with_gait, velocity_ppo_runner_cfg",
}
_OTHER_PROFILE = "from mjlab.tasks.velocity.rl.ppo import cpu_without_gait, velocity_ppo_runner_cfg"


def velocity_source(report: RobotReport, package: str, title: str, task_name: str) -> str:
    """Return the source of the velocity task."""
    mode, _ = foot_contacts(report)
    tolerance = {name: report.pose_tolerance.value[name] for name in motor_joints(report)}
    fallen = report.anatomy.fall_bodies
    commands = report.commands.value
    num_feet = len(report.anatomy.feet.value)
    friction_reason, friction = _joint_friction(report)
    names = [
        "ACTION_SCALE",
        "FEET",
        "FOOT_CONTACTS",
        *["HEIGHT"] * (num_feet in _PROFILES),
        "SOLES",
        "TRUNK",
        "UPRIGHT",
    ]
    return template("legged_task.py").substitute(
        package=package,
        title=title,
        task_name=task_name,
        profile=_PROFILES.get(num_feet, _OTHER_PROFILE),
        robot_names="".join(f"    {name},\n" for name in [*names, "get_robot_cfg"]),
        commands="\n".join(reason_lines("Commands", report.commands)),
        lin_vel=_range(commands["lin_vel_x"]),
        ang_vel=_range(commands["ang_vel_z"]),
        tolerance_reason="\n".join(
            joint_reason_lines(
                "Tolerance of joints around the initial pose (rad)", report.pose_tolerance, report
            )
        ),
        std_walking=dict_source(by_pattern(tolerance, report)),
        friction_reason="\n".join(comment_lines(friction_reason)),
        joint_friction=friction,
        fallen_reason="\n".join(reason_lines("Bodies that touch the ground after a fall", fallen)),
        fallen=tuple_source(fallen.value, 9),
        contact_mode=f'"{mode}"',
        ray_radius=number(_sole_radius(report)),
        swing_height=number(lift(report.root_height.value, num_feet), 2),
        gait=_gait(report),
    )


def reach_source(report: RobotReport, package: str, title: str) -> str:
    """Return the source of the reach task."""
    model, data = report.compiled, mujoco.MjData(report.compiled)
    geometry.set_pose(model, data, report.joint_pos.value)
    extent = float(np.linalg.norm(np.ptp(data.geom_xpos, axis=0)))
    return template("reach_task.py").substitute(
        package=package, title=title, viewer_distance=number(max(0.5, 2.0 * extent), 2)
    )


def tracking_source(report: RobotReport, package: str, title: str, motion: str) -> str:
    """Return the source of the tracking task, of a motion file by its name."""
    bodies, ends = tracked_bodies(report)
    return template("tracking_task.py").substitute(
        package=package,
        title=title,
        motion=motion,
        bodies=tuple_source(bodies, 9),
        end_effectors=tuple_source(ends, 16),
    )


def tracked_bodies(report: RobotReport) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the bodies that follow a motion, the trunk first, and the ends of the limbs."""
    anatomy, model = report.anatomy, report.compiled
    legs = [leg.joints for leg in anatomy.legs.value]
    limbs = legs + [hand.joints for hand in anatomy.hands.value]
    # A waist moves several limbs.
    count = Counter(joint for limb in limbs for joint in limb)
    trunk, upright = anatomy.trunk.value, anatomy.upright.value
    bodies, ends = dict.fromkeys((trunk, upright)), []
    for limb in limbs:
        own = [joint for joint in limb if count[joint] == 1]
        if not own:
            continue
        links = [model.body(int(model.joint(joint).bodyid[0])).name for joint in own]
        bodies |= dict.fromkeys(links[n] for n in (len(own) // 4, len(own) // 2, len(own) - 1))
        ends.append(links[-1])
    return tuple(bodies), tuple(ends)


def _range(bounds: tuple[float, float]) -> str:
    return f"({number(bounds[0])}, {number(bounds[1])})"


def _joint_friction(report: RobotReport) -> tuple[str, str]:
    """Return the reason and the source of the ranges of dry friction."""
    names, model = motor_joints(report), report.compiled
    if any(model.dof_frictionloss[model.joint(name).dofadr[0]] > 0.0 for name in names):
        return "Dry friction of joints. None: 0.75 to 1.25 times that of the file.", "None"
    limits = by_pattern({name: report.effort.value[name] for name in names}, report)
    ranges = {name: (0.0, GEAR_FRICTION * limit) for name, limit in limits.items()}
    reason = (
        f"Dry friction of joints (N m): not in the file. Up to {GEAR_FRICTION:.0%} of the effort limit, as "
        "the motors of the Unitree G1 have it."
    )
    return reason, dict_source(ranges)


def _sole_radius(report: RobotReport) -> float:
    """Return the radius (m) of the rays about a foot: that of the Go1's for a leg of 0.28 m."""
    return round(0.04 * float(np.clip(report.root_height.value / 0.28, 0.5, 1.5)), 3)


def _gait(report: RobotReport) -> str:
    """Return the lines of the profile `cpu`."""
    num_feet = len(report.anatomy.feet.value)
    if num_feet == 2:
        return _walk(report)
    if num_feet == 4:
        return _trot(report)
    reason = f"The gait is unknown: the profile rewards air time of the feet. {_STOPS}"
    return "\n".join([*comment_lines(reason), "cpu = cpu_without_gait(", *_arguments(report), ")"])


def _arguments(report: RobotReport) -> list[str]:
    """Return the arguments of all profiles."""
    solved = SOLVED[2 if len(report.anatomy.feet.value) == 2 else 4]
    arguments = [
        "    solved_below={",
        *(f'        "{name}": {limit},' for name, limit in solved.items()),
        "    },",
    ]
    if not report.anatomy.mirror.value:
        arguments.append("    mirror=None,  # not the same left and right")
    return arguments


def _walk(report: RobotReport) -> str:
    left = feet_in_model_order(report).index(report.anatomy.feet.value[0])
    bounds, pose = leg_limits(report)
    return "\n".join(
        [
            *comment_lines(
                "Largest offset of a joint target from the initial pose (rad), and weights of squared "
                "deviations from it: those of the G1 by the role of the joint."
            ),
            f"BOUNDS = {dict_source(by_pattern(bounds, report))}",
            f"DEVIATIONS = {dict_source(by_pattern(pose, report))}",
            "",
            *comment_lines(
                "A walk: a controller that steps in place by inverse kinematics of the legs teaches the "
                "policy at first. Frequency, swing height and gains follow from HEIGHT, mass and legs. "
                f"Training episodes end when the trunk sinks below {STANDING_SHARE:.0%} of its height. "
                f"{_STOPS}"
            ),
            "BIPED = Biped(",
            f"    feet=(FEET[{left}], FEET[{1 - left}]),  # left, right",
            "    height=0.97 * HEIGHT,",
            f"    minimum_height={STANDING_SHARE} * HEIGHT,",
            f"    feet_distance={number(FEET_DISTANCE * feet_distance(report), 2)},",
            "    bounds=BOUNDS,",
            "    pose=DEVIATIONS,",
            *["    has_ankles=False,"] * (not has_ankles(report)),
            ")",
            "cpu = cpu_with_stepping(",
            "    BIPED,",
            *_arguments(report),
            ")",
        ]
    )


def leg_limits(report: RobotReport) -> tuple[dict[str, float], dict[str, float]]:
    """Return bounds (rad) and weights of deviations of the joints of a biped, by joint.

    Those of the G1: hip pitch and knee may move by 1 rad at no cost, a hip's roll and yaw by 0.6 rad, an
    ankle's pitch by 1 rad and roll by 0.8 rad, and other joints by 0.25 rad.
    """
    joints = motor_joints(report)
    bounds, pose = dict.fromkeys(joints, 0.25), dict.fromkeys(joints, 50.0)
    for leg in report.anatomy.legs.value:
        pitch = pitch_joints(report.compiled, leg)
        knee = _knee(report, leg)
        yaw = _yaw_joint(report, leg.joints[:knee])
        for index, name in enumerate(leg.joints):
            if name in pitch[:2]:
                bounds[name], pose[name] = 1.0, 0.01
            elif index < knee:
                bounds[name], pose[name] = 0.6, 5.0 if name == yaw else 1.0
            else:
                bounds[name], pose[name] = 1.0 if name in pitch else 0.8, 5.0
    return {n: bounds[n] for n in joints}, {n: pose[n] for n in joints}


def has_ankles(report: RobotReport) -> bool:
    """Return true if all legs have joints below the knee."""
    return all(_knee(report, leg) + 1 < len(leg.joints) for leg in report.anatomy.legs.value)


def _knee(report: RobotReport, leg: Leg) -> int:
    """Return the index of a leg's knee, its second pitch joint; the number of joints without one."""
    pitch = pitch_joints(report.compiled, leg)
    return leg.joints.index(pitch[1]) if len(pitch) > 1 else len(leg.joints)


def _yaw_joint(report: RobotReport, joints: Sequence[str]) -> str | None:
    """Return the joint that turns a leg, of those above its knee; None without one."""
    # Imports torch.
    from mjlab.utils.leg_kinematics import turning_joint

    model, data = report.compiled, mujoco.MjData(report.compiled)
    geometry.set_pose(model, data, report.joint_pos.value)
    index = turning_joint(data.xaxis[[model.joint(name).id for name in joints]])
    return None if index is None else joints[index]


def feet_distance(report: RobotReport) -> float:
    """Return the lateral distance of two soles in the initial pose (m)."""
    model, data = report.compiled, mujoco.MjData(report.compiled)
    geometry.set_pose(model, data, report.joint_pos.value)
    left, right = (
        float(np.mean(sole_points(model, data, foot)[:, 1])) for foot in report.anatomy.feet.value
    )
    return left - right


def _trot(report: RobotReport) -> str:
    first, second = diagonals(report)
    reason = (
        f"A trot: the feet {first} and {second} of FEET, the diagonals, take turns. Training episodes end "
        f"when the trunk sinks below {STANDING_SHARE:.0%} of its height. {_STOPS}"
    )
    return "\n".join(
        [
            *comment_lines(reason),
            "cpu = cpu_with_gait(",
            f"    ({first}, {second}),",
            f"    minimum_height={STANDING_SHARE} * HEIGHT,",
            *_arguments(report),
            ")",
        ]
    )


def diagonals(report: RobotReport) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the feet on both diagonals of a quadruped, by their place in model order."""
    order = [foot.link for foot in feet_in_model_order(report)]
    front_left, front_right, rear_left, rear_right = (
        order.index(foot.link) for foot in report.anatomy.feet.value
    )
    first = (min(front_left, rear_right), max(front_left, rear_right))
    second = (min(front_right, rear_left), max(front_right, rear_left))
    return (first, second) if first < second else (second, first)
