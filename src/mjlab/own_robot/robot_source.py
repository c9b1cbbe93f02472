"""Source of the robot file of a written package."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from mjlab.own_robot import geometry
from mjlab.own_robot.anatomy import SOLE_RULE, Foot, like_joints
from mjlab.own_robot.findings import soft_soles
from mjlab.own_robot.guess import Guess, JointGuess
from mjlab.own_robot.model_source import name_elements
from mjlab.own_robot.python_text import (
    comment_lines,
    commented,
    dict_source,
    literal,
    number,
    pattern,
    tuple_source,
)
from mjlab.own_robot.report import RobotReport
from mjlab.own_robot.templates import template

SOLE_FRICTION = 0.8
"""Sliding friction of soles, in the middle of the range that velocity tasks randomize."""
_RAY_GROUP, _VISUAL_GROUP, _COLLISION_GROUP = 0, 2, 3
_MARKS = {"asked": " (ASKED: not in the file)"}


def robot_source(report: RobotReport, title: str, model: Path) -> str:
    """Return the source of the robot file.

    Args:
        report: Values of the robot.
        title: Name of the robot.
        model: Model file, relative to the folder of models.
    """
    is_urdf = model.suffix.lower() == ".urdf"
    joints = motor_joints(report)
    imports = []
    if _unnamed(report):
        imports.append("from mjlab.own_robot.model_source import name_elements")
    if is_urdf:
        imports.append("from mjlab.utils.urdf import read_urdf")
    motor_reasons, motors = _motors(report, joints)
    scale = {name: report.action_scale.value[name] for name in joints}
    return template("robot.py").substitute(
        title=title,
        imports="".join(f"{line}\n" for line in imports),
        model=model.as_posix(),
        parts="\n".join(_parts(report)),
        pose="\n".join(_pose(report)),
        motor_reasons="\n".join(motor_reasons),
        motors="\n".join(motors),
        scale="\n".join(
            joint_reason_lines("Joint target (rad) per unit action", report.action_scale, report)
        ),
        action_scale=dict_source(
            by_pattern(scale, report) if report.anatomy.kind.value == "legged" else scale
        ),
        spec="\n".join(f"    {line}" if line else "" for line in _spec(report, is_urdf)),
    )


def motor_joints(report: RobotReport) -> tuple[str, ...]:
    """Return the joints with motors: those with an actuator in the file; all if it has none."""
    drives = report.anatomy.drives.value
    return tuple(name for name, drive in drives.items() if drive != "none") or tuple(drives)


def feet_in_model_order(report: RobotReport) -> tuple[Foot, ...]:
    """Return the feet in the order of contact sensors and sites."""
    return tuple(
        sorted(report.anatomy.feet.value, key=lambda foot: report.compiled.body(foot.link).id)
    )


def foot_contacts(report: RobotReport) -> tuple[str, tuple[str, ...]]:
    """Return how contacts of feet are matched, and one name per foot in model order.

    Geoms if each foot has one sole; else the bodies of the soles.
    """
    feet = feet_in_model_order(report)
    if all(len(foot.sole) == 1 for foot in feet):
        return "geom", tuple(foot.sole[0] for foot in feet)
    bodies = [{int(report.compiled.geom(name).bodyid[0]) for name in foot.sole} for foot in feet]
    if all(len(found) == 1 for found in bodies):
        return "body", tuple(report.compiled.body(found.pop()).name for found in bodies)
    return "subtree", tuple(foot.link for foot in feet)


def foot_names(report: RobotReport) -> tuple[str, ...]:
    """Return a new name for the site of each foot, in model order."""
    taken = {site.name for site in report.spec.sites}
    names = []
    for foot in feet_in_model_order(report):
        body = report.compiled.body(int(report.compiled.geom(foot.sole[0]).bodyid[0])).name
        name = body if "foot" in body.lower() else f"{body}_foot"
        while name in taken:
            name += "_sole"
        taken.add(name)
        names.append(name)
    return tuple(names)


def by_pattern(values: Mapping[str, float], report: RobotReport) -> dict[str, float]:
    """Return values by joint name pattern; joints that serve alike, with the same value, share one."""
    among, patterns = report.joint_pos.value, {}
    for group in like_joints(report.anatomy, values):
        equal: dict[str, list[str]] = {}
        for name in group:
            equal.setdefault(number(values[name]), []).append(name)
        patterns |= {pattern(names, among): float(value) for value, names in equal.items()}
    return patterns


def reason_lines(what: str, guess: Guess) -> list[str]:
    """Return a comment with the reason of a value."""
    return comment_lines(f"{what}: {guess.rule}{_MARKS.get(guess.source, '')}.")


def joint_reason_lines(what: str, guess: JointGuess, report: RobotReport) -> list[str]:
    """Return comments with the reasons of the values of joints, and the joints of each."""
    found = guess.by_reason()
    joints = {
        reason: "" if len(found) == 1 else f" of {', '.join(by_pattern(values, report))}"
        for reason, values in found.items()
    }
    return [
        line
        for reason, of_joints in joints.items()
        for line in comment_lines(
            f"{what}{of_joints}: {reason.rule}{_MARKS.get(reason.source, '')}."
        )
    ]


def _parts(report: RobotReport) -> list[str]:
    anatomy = report.anatomy
    lines = [commented(f"TRUNK = {literal(anatomy.trunk.value)}", anatomy.trunk.rule)]
    if anatomy.colliding.source == "rule":
        lines += [
            *reason_lines("Geoms that collide", anatomy.colliding),
            f"COLLIDING = {tuple_source(anatomy.colliding.value, 12)}",
        ]
    if anatomy.kind.value != "legged":
        return lines + _arm_parts(report)
    lines.append(commented(f"UPRIGHT = {literal(anatomy.upright.value)}", anatomy.upright.rule))
    imu, reason = imu_site(report)
    lines.append(commented(f"IMU = {literal(imu)}", reason))
    feet, names = feet_in_model_order(report), foot_names(report)
    soles = [name for foot in feet for name in foot.sole]
    _, contacts = foot_contacts(report)
    lines += [
        *comment_lines(f"Feet, in model order: {anatomy.feet.rule}; soles: {SOLE_RULE}."),
        "# Sites that `get_spec` adds: body, and middle of the sole in its frame.",
        "FOOT_SITES = {",
        *(
            f"    {literal(name)}: ({literal(foot.link)}, {_rounded(foot.position)}),"
            for name, foot in zip(names, feet, strict=True)
        ),
        "}",
        "FEET = tuple(FOOT_SITES)",
        f"SOLES = {tuple_source(soles, 8)}",
        f"FOOT_CONTACTS = {tuple_source(contacts, 16)}",
    ]
    return lines


def _arm_parts(report: RobotReport) -> list[str]:
    """Return the first hand, its site and its joints."""
    if not report.anatomy.hands.value:
        return []
    hand, (site, reason) = report.anatomy.hands.value[0], hand_site(report)
    lines = []
    if len(report.anatomy.hands.value) > 1:
        others = ", ".join(other.link for other in report.anatomy.hands.value[1:])
        lines += comment_lines(f"Of several hands, the first; the others are on {others}.")
    lines += [
        commented(f"HAND = {literal(site)}", f"site: {reason}"),
        commented(f"ARM = {tuple_source(hand.joints, 6)}", "joints from the base to the hand")
        if len(hand.joints) < 4
        else f"ARM = {tuple_source(hand.joints, 6)}",
    ]
    if hand.gripper:
        lines.append(f"GRIPPER = {tuple_source(hand.gripper, 10)}")
    return lines


def hand_site(report: RobotReport) -> tuple[str, str]:
    """Return the site of the hand, and the reason; `get_spec` adds it if the file has none."""
    hand = report.anatomy.hands.value[0]
    if hand.site is not None:
        return hand.site, "at the grasp"
    taken = {site.name for site in report.spec.sites}
    return "hand" if "hand" not in taken else "reaching_hand", f"added to {hand.link}"


def imu_site(report: RobotReport) -> tuple[str, str]:
    """Return the site whose velocity is measured, and the reason.

    The site of the file if it is on the trunk and has the trunk's axes, which mirror images expect;
    else one that `get_spec` adds at the trunk's origin.
    """
    found, model = report.anatomy.imu_site, report.compiled
    taken = {site.name for site in report.spec.sites}
    new = "imu" if "imu" not in taken else "trunk_imu"
    if found.value is None:
        return new, f"added: {found.rule}"
    site = model.site(found.value)
    trunk = model.body(report.anatomy.trunk.value).id
    if int(site.bodyid[0]) != trunk:
        return new, f"added at the trunk's origin: {found.value} is on another body"
    if np.abs(np.abs(site.quat[0]) - 1.0) > 1e-6:
        return new, f"added at the trunk's origin: {found.value} is rotated"
    return found.value, found.rule


def _pose(report: RobotReport) -> list[str]:
    pose, height = report.joint_pos, report.root_height
    values = {name: value for name, value in pose.value.items() if number(value) != "0.0"}
    return [
        commented(f"HEIGHT = {number(height.value)}", height.rule),
        *joint_reason_lines("Joint positions (others: 0)", pose, report),
        f"POSE = {dict_source(by_pattern(values, report))}",
    ]


def _motors(report: RobotReport, joints: tuple[str, ...]) -> tuple[list[str], list[str]]:
    """Return the comment with the reasons, and one actuator config per group of equal motors."""
    fields = {
        "stiffness": report.stiffness,
        "damping": report.damping,
        "effort_limit": report.effort,
        "armature": report.armature,
    }
    reasons = [
        line for name, guess in fields.items() for line in joint_reason_lines(name, guess, report)
    ]
    if report.armature.source == "file":
        # What the file has stays as it is.
        del fields["armature"]
    settings = {name: "effort" if name == "effort_limit" else name for name in fields}
    groups: dict[tuple[str, ...], list[str]] = {}
    for group in like_joints(report.anatomy, joints):
        for joint in group:
            key = tuple(
                # Answers as they were given.
                repr(guess.value[joint])
                if joint in report.answers[settings[name]]
                else number(guess.value[joint], 3)
                for name, guess in fields.items()
            )
            groups.setdefault((group[0], *key), []).append(joint)
    lines = []
    for (_, *values), names in groups.items():
        target = literal(pattern(names, report.joint_pos.value))
        lines += [
            "    BuiltinPositionActuatorCfg(",
            f"        target_names_expr=({target},),",
            *(f"        {field}={value}," for field, value in zip(fields, values, strict=True)),
            "    ),",
        ]
    return reasons, lines


def _rounded(position: tuple[float, float, float]) -> tuple[float, ...]:
    """Return a position with four decimals, without -0.0."""
    return tuple(round(x, 4) + 0.0 for x in position)


def _spec(report: RobotReport, is_urdf: bool) -> list[str]:
    """Return the body of `get_spec`."""
    spec = report.model.spec
    if is_urdf:
        floating = geometry.free_joint(report.compiled) is not None
        lines = [f"spec = read_urdf(MODEL, floating_base={floating})"]
    else:
        lines = ["spec = mujoco.MjSpec.from_file(str(MODEL))"]
    unnamed = _unnamed(report)
    if unnamed:
        shown = ", ".join(unnamed[:3]) + (", ..." if len(unnamed) > 3 else "")
        lines += [*comment_lines(f"The file leaves {len(unnamed)} elements unnamed: {shown}."),
                  "name_elements(spec)"]  # fmt: skip
    lines += _removals(report, spec) + _physics(spec)
    if not is_urdf and len(report.spec.joints) > len(spec.joints):
        lines += ["# The file has a fixed base.", "spec.body(TRUNK).add_freejoint()"]
    if any(g.group == _RAY_GROUP for b in spec.bodies[1:] for g in b.geoms):
        has_visuals = any(not (g.contype or g.conaffinity) for g in spec.geoms)
        group = f"{_COLLISION_GROUP} if geom.contype or geom.conaffinity else {_VISUAL_GROUP}"
        lines += [
            "# Rays of the terrain scan see geom group 0.",
            "for geom in spec.geoms:",
            "    if geom.group == 0:",
            f"        geom.group = {group if has_visuals else _VISUAL_GROUP}",
        ]
    if report.anatomy.colliding.source == "rule":
        lines += [
            "# With the ground, not with each other.",
            "for name in COLLIDING:",
            "    spec.geom(name).conaffinity = 1",
        ]
    if report.anatomy.kind.value == "legged":
        return lines + _legged_spec(report)
    if report.anatomy.hands.value and report.anatomy.hands.value[0].site is None:
        hand = report.anatomy.hands.value[0]
        lines += [
            *comment_lines(f"The grasp: {report.anatomy.hands.rule}."),
            f"spec.body({literal(hand.link)}).add_site(name=HAND, pos={_rounded(hand.position)})",
        ]
    return lines


def _removals(report: RobotReport, spec: mujoco.MjSpec) -> list[str]:
    lines = []
    joints = set(motor_joints(report))
    replaced = [a for a in spec.actuators if a.target in joints]
    if replaced or spec.keys:
        actuators = (
            "*spec.actuators" if len(replaced) == len(spec.actuators)
            else f"*(a for a in spec.actuators if a.target in {tuple_source(sorted(joints), 40)})"
        )  # fmt: skip
        parts = [actuators] * bool(replaced) + ["*spec.keys"] * bool(spec.keys)
        what = ["the actuators"] * bool(replaced) + ["keyframes"] * bool(spec.keys)
        lines += [
            f"# ACTUATORS and POSE take the place of {' and '.join(what)}.",
            f"for element in ({', '.join(parts)}{',' if len(parts) == 1 else ''}):",
            "    spec.delete(element)",
        ]
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    if any(geom.type == plane for geom in spec.worldbody.geoms):
        lines += [
            "# The task has its own ground.",
            "for geom in list(spec.worldbody.geoms):",
            "    if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:",
            "        spec.delete(geom)",
        ]
    return lines


def _physics(spec: mujoco.MjSpec) -> list[str]:
    """Return lines that leave the physics to the task, without a notice at each start."""
    option, lines = spec.option, []
    if option.impratio != 1.0 or option.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        lines += [
            f"spec.option.impratio = 1.0  # {number(option.impratio)} in the file",
            "spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL",
        ]
    if spec.nconmax != -1 or spec.njmax != -1:
        lines.append("spec.nconmax = spec.njmax = -1")
    if lines:
        lines.insert(
            0, "# The task sets the physics: `cfg.sim`. Elliptic cones cost twice the time."
        )
    return lines


def _soft_soles(report: RobotReport) -> list[str]:
    """Return lines that make soles as hard as MuJoCo's default if those of the file slide."""
    model = report.compiled
    found = soft_soles(model, report.anatomy)
    if not found:
        return []
    softest = min(float(model.geom_solimp[g, 0]) for g in found)
    return [
        f"    # Softer ones (impedance {number(softest)} in the file) need elliptic cones and impratio 100.",
        "    sole.solref, sole.solimp = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)",
    ]


def _shared_bodies(report: RobotReport) -> list[str]:
    """Return the bodies beside a floating base that can be left out: without joints, not referred to."""
    spec = report.model.spec.copy()
    root = report.compiled.body_rootid[report.compiled.body(report.anatomy.trunk.value).id]
    found = []
    for body in list(spec.worldbody.bodies):
        if not body.name or body.name == report.compiled.body(root).name or body.joints:
            continue
        trial = spec.copy()
        trial.delete(trial.body(body.name))
        try:
            trial.compile()
        except ValueError:
            continue
        found.append(body.name)
    return found


def _legged_spec(report: RobotReport) -> list[str]:
    lines = [
        "for name in SOLES:",
        "    sole = spec.geom(name)",
        "    # Priority: the friction of the sole counts, not that of the ground. condim: with friction.",
        "    sole.priority, sole.condim = 1, 3",
        f"    sole.friction[0] = {SOLE_FRICTION}  # middle of the range of the event foot_friction",
        *_soft_soles(report),
        "for name, (body, position) in FOOT_SITES.items():",
        "    spec.body(body).add_site(name=name, pos=position)",
    ]
    if imu_site(report)[0] not in {site.name for site in report.spec.sites}:
        lines.append("spec.body(TRUNK).add_site(name=IMU)")
    taken = {sensor.name for sensor in report.spec.sensors}
    sensors = {
        "imu_lin_vel": ("VELOCIMETER", "SITE", "IMU"),
        "imu_ang_vel": ("GYRO", "SITE", "IMU"),
        "root_angmom": ("SUBTREEANGMOM", "BODY", "TRUNK"),
    }
    for name in _shared_bodies(report):
        lines += [
            "# Fixed to the world: all environments would share it.",
            f"spec.delete(spec.body({literal(name)}))",
        ]
    lines.append("# Sensors that the task reads.")
    for name, (kind, object_type, owner) in sensors.items():
        if name in taken:
            continue
        lines += [
            "spec.add_sensor(",
            f'    name="{name}",',
            f"    type=mujoco.mjtSensor.mjSENS_{kind},",
            f"    objtype=mujoco.mjtObj.mjOBJ_{object_type},",
            f"    objname={owner},",
            ")",
        ]
    return lines


def _unnamed(report: RobotReport) -> list[str]:
    """Return the names that `name_elements` gives."""
    return name_elements(report.model.spec.copy())
