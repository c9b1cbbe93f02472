"""Standing pose of a legged robot: the keyframe that passes the checks, else a searched one.

Poses are joint positions by name, with the trunk level. The search bends the pitch joints of one leg
until the sole is level and below the center of mass at `EXTENSION` of its length, and mirrors it.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull, QhullError

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, Foot, Leg, candidate_poses, foot_links
from mjlab.own_robot.guess import Guess, JointGuess, Question

EXTENSION = {2: 0.92, 4: 0.75}
"""Height of the hips above the soles in a searched pose, as a share of the leg's length, by number of legs:
0.87 to 0.95 in the keyframes of Berkeley Humanoid, Apollo, T1, H1 and G1; 0.67 to 0.70 in those of Go1,
Aliengo, B2 and HyQReal, 0.8 of Spot."""
MIN_TRUNK_HEIGHT = 0.55
"""Height of the trunk in a standing pose, as a share of that with straight legs."""
OVER_SOLES = 0.02
"""Distance of the center of mass from the soles, seen from above, as a share of its height: two feet with
spheres for soles have a hull of millimeters."""
MARGIN = 0.05
"""Share of a joint's range kept free at both ends in a searched pose."""


@dataclass(frozen=True)
class Posture:
    """Standing pose."""

    joint_pos: JointGuess
    """Position of each hinge and slide (rad, m)."""
    root_height: Guess[float]
    """Height of the trunk's frame with the lowest colliding geom on the ground (m)."""
    leg_length: float
    """Height of the trunk's frame above the soles with straight legs (m)."""
    questions: tuple[Question, ...] = ()


def find_posture(
    model: mujoco.MjModel, anatomy: Anatomy, answers: dict[str, float] | None = None
) -> Posture:
    """Return the standing pose of a legged robot.

    Args:
        model: Robot.
        anatomy: Parts of the robot.
        answers: Positions of joints set by the user; the searched pose starts from them.
    """
    answers = answers or {}
    data = mujoco.MjData(model)
    straight = straight_height(model, anatomy)
    rejected = []
    for name, qpos in candidate_poses(model):
        joint_pos = {
            model.joint(j).name: float(qpos[model.jnt_qposadr[j]]) for j in geo.joint_ids(model)
        }
        faults = check_pose(model, anatomy, joint_pos, straight)
        if name != "zero pose" and not faults:
            rule, source = f"{name}: stands, inside limits, feet mirrored", "file"
            questions: tuple[Question, ...] = ()
            break
        rejected.append((name, faults))
    else:
        joint_pos, questions = _searched_pose(model, anatomy, straight, answers)
        if faults := check_pose(model, anatomy, joint_pos, straight):
            text = f"standing pose: the best found does not stand, {'; '.join(faults)}"
            questions += (Question("pose", text, "the best found"),)
        why = "; ".join(f"{name}: {faults[0]}" for name, faults in rejected[:-1]) or "no keyframe"
        source = "asked" if questions else "rule"
        share = EXTENSION[2 if len(anatomy.legs.value) == 2 else 4]
        rule = f"{why}; soles level, legs at {share} of their length, mirrored"
    rounded = {name: round(position, 4) + 0.0 for name, position in joint_pos.items()}
    pose = JointGuess.of(rounded, rule, source).answered(answers)
    height = ground_height(model, data, anatomy, pose.value)
    return Posture(pose, Guess(height, "lowest colliding geom on the ground"), straight, questions)


def ground_height(
    model: mujoco.MjModel, data: mujoco.MjData, anatomy: Anatomy, joint_pos: dict[str, float]
) -> float:
    """Return the height of the trunk's frame at which the lowest colliding geom touches the ground."""
    geo.set_pose(model, data, joint_pos)
    geoms = [model.geom(name).id for name in anatomy.colliding.value]
    trunk = model.body(anatomy.trunk.value).id
    return float(data.xpos[trunk][2]) - geo.lowest_height(model, data, geoms)


def check_pose(
    model: mujoco.MjModel, anatomy: Anatomy, joint_pos: dict[str, float], straight: float
) -> list[str]:
    """Return the reasons why a robot cannot stand in a pose; empty if it can.

    Args:
        model: Robot.
        anatomy: Parts of the robot.
        joint_pos: Position of each joint.
        straight: Height of the trunk with straight legs (m); see `straight_height`.
    """
    data = mujoco.MjData(model)
    faults = []
    for name, position in joint_pos.items():
        low, high = geo.joint_range(model, model.joint(name).id)
        if not low - 0.01 <= position <= high + 0.01:
            faults.append(f"{name} at {position:.2f} outside [{low:.2f}, {high:.2f}]")
    geo.set_pose(model, data, joint_pos)
    for tendon in np.flatnonzero(geo.tendon_excess(model, data) > 0.01):
        faults.append(f"tendon {model.tendon(tendon).name} outside its range")
    trunk = model.body(anatomy.trunk.value).id
    feet = {model.body(foot.link).id for foot in anatomy.feet.value}
    lowest = set(foot_links(model, data, trunk))
    if not feet <= lowest:
        names = [model.body(link).name for link in feet - lowest]
        faults.append(f"feet {names} off the ground")
    height = ground_height(model, data, anatomy, joint_pos)
    if height < MIN_TRUNK_HEIGHT * straight:
        faults.append(f"trunk at {height:.2f} m, {height / straight:.0%} of straight legs")
    if not over_soles(model, data, anatomy):
        faults.append("center of mass outside the soles")
    if not _feet_mirrored(data, model, anatomy):
        faults.append("left and right feet not mirrored")
    return faults


def sole_points(model: mujoco.MjModel, data: mujoco.MjData, foot: Foot) -> np.ndarray:
    """Return the points of a foot that touch level ground, (P, 3), from the pose of `data`."""
    geoms = [model.geom(name).id for name in foot.sole]
    return np.vstack([geo.ground_points(model, data, geom) for geom in geoms])


def straight_height(model: mujoco.MjModel, anatomy: Anatomy) -> float:
    """Return the greatest height of the trunk above a sole, over the pitch joints of a leg (m)."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    clipped = _clipped_zero(model)
    best = 0.0
    for leg, foot in zip(anatomy.legs.value[:2], anatomy.feet.value[:2], strict=True):
        joints = pitch_joints(model, leg)
        ranges = np.array([geo.joint_range(model, model.joint(j).id) for j in joints])

        geo.set_pose(model, data, clipped)
        addresses = geo.qpos_addresses(model, joints)

        def depth(angles: np.ndarray, addresses=addresses, foot=foot) -> float:
            data.qpos[addresses] = angles
            mujoco.mj_kinematics(model, data)
            return -float(_sole_position(model, data, anatomy, foot)[2])

        if not joints:
            best = max(best, depth(np.zeros(0)))
            continue
        samples = rng.uniform(ranges[:, 0], ranges[:, 1], (300, len(joints)))
        start = max(samples, key=depth)
        for width in (0.2, 0.05, 0.02):
            for _ in range(40):
                trial = np.clip(start + width * rng.normal(size=len(joints)), *ranges.T)
                start = max(start, trial, key=depth)
        best = max(best, depth(start))
    return best


def pitch_joints(model: mujoco.MjModel, leg: Leg) -> list[str]:
    """Return the joints of a leg that turn about the trunk's y axis at `qpos0`."""
    data = mujoco.MjData(model)
    geo.set_pose(model, data, {})
    return [name for name in leg.joints if abs(float(data.xaxis[model.joint(name).id][1])) > 0.7]


def _searched_pose(
    model: mujoco.MjModel, anatomy: Anatomy, straight: float, answers: dict[str, float]
) -> tuple[dict[str, float], tuple[Question, ...]]:
    """Return the searched pose, and a question for each knee that may bend both ways."""
    pose = _clipped_zero(model) | answers
    mirror, questions, solved = anatomy.mirror.value, [], set()
    for leg, foot in zip(anatomy.legs.value, anatomy.feet.value, strict=True):
        if leg.joints[0] in solved:
            continue
        angles, other = _bend(model, anatomy, leg, foot, pose, straight, answers)
        pose |= angles
        solved |= set(leg.joints)
        if all(name in mirror for name in leg.joints):
            image = {mirror[name][0]: mirror[name][1] * pose[name] for name in leg.joints}
            pose |= {name: value for name, value in image.items() if name not in answers}
            solved |= set(image)
        if other is not None and angles:
            knee = max(angles, key=lambda name: abs(angles[name] - other[name]))
            direction = "forward" if knee_forward(model, anatomy, leg, pose) else "backward"
            questions.append(
                Question(
                    f"pose.{knee}",
                    f"direction of the knee of {leg.foot}: it may bend both ways "
                    f"({angles[knee]:.2f} or {other[knee]:.2f} rad)",
                    f"{direction}, {knee} = {angles[knee]:.2f}",
                )
            )
    return pose, tuple(questions)


def _bend(
    model: mujoco.MjModel,
    anatomy: Anatomy,
    leg: Leg,
    foot: Foot,
    pose: dict[str, float],
    straight: float,
    answers: dict[str, float],
) -> tuple[dict[str, float], dict[str, float] | None]:
    """Return the angles of a leg's free pitch joints, and those with the knee the other way if any."""
    joints = [name for name in pitch_joints(model, leg) if name not in answers]
    if not joints:
        return {}, None
    data = mujoco.MjData(model)
    geo.set_pose(model, data, pose)
    hip = data.xanchor[model.joint(joints[0]).id].copy()
    length = straight + float(hip[2])
    depth = float(hip[2]) - EXTENSION[2 if len(anatomy.legs.value) == 2 else 4] * length
    link, trunk = model.body(foot.link).id, model.body(anatomy.trunk.value).id
    # A leg without an ankle cannot keep its sole level.
    level = 0.3 if len(joints) > 2 else 0.0
    ranges = np.array([geo.joint_range(model, model.joint(j).id) for j in joints])
    slack = MARGIN * np.ptp(ranges, axis=1)
    low, high = ranges[:, 0] + slack, ranges[:, 1] - slack
    two_legs = len(anatomy.legs.value) == 2
    addresses = geo.qpos_addresses(model, joints)
    # Both legs of two move alike; of more, the others stay.
    mirror = anatomy.mirror.value if two_legs else {}
    partners = [mirror.get(name, (name, 1.0)) for name in joints]
    images = geo.qpos_addresses(model, [name for name, _ in partners])
    signs = np.array([sign for _, sign in partners])

    def residual(angles: np.ndarray) -> np.ndarray:
        data.qpos[addresses] = angles
        data.qpos[images] = signs * angles
        geo.update(model, data)
        # Two legs carry the center of mass above the soles; four and more stand below their hips.
        x = float(data.subtree_com[trunk][0]) if two_legs else float(hip[0])
        sole = _sole_position(model, data, anatomy, foot)
        place = np.array([sole[0] - x, sole[2] - depth]) / length
        tilt = data.xmat[link].reshape(3, 3) @ np.array(foot.normal) - np.array([0.0, 0.0, 1.0])
        excess = geo.tendon_excess(model, data)
        return np.concatenate([place, level * tilt, excess, 1e-3 * angles])

    rng, found = np.random.default_rng(0), []
    for _ in range(12):
        start = rng.uniform(low, high)
        result = least_squares(residual, start, bounds=(low, high), max_nfev=60)
        found.append((float(result.cost), result.x))
    found.sort(key=lambda item: item[0])
    good = [x for cost, x in found if cost < found[0][0] + 1e-4]

    def forward(angles: np.ndarray) -> bool:
        return knee_forward(model, anatomy, leg, pose | dict(zip(joints, angles, strict=True)))

    # Two legs bend their knees forward as humans do; four, backward, as nearly all do.
    want = len(anatomy.legs.value) == 2
    chosen = next((x for x in good if forward(x) == want), good[0])
    other = next((x for x in good if forward(x) != forward(chosen)), None)
    as_dict = {name: float(a) for name, a in zip(joints, chosen, strict=True)}
    return as_dict, None if other is None else dict(zip(joints, map(float, other), strict=True))


def knee_forward(model: mujoco.MjModel, anatomy: Anatomy, leg: Leg, pose: dict[str, float]) -> bool:
    """Return True if the second pitch joint of a leg is ahead of the line from the first to the last."""
    data = mujoco.MjData(model)
    geo.set_pose(model, data, pose)
    joints = pitch_joints(model, leg)
    foot = next(foot for foot in anatomy.feet.value if foot.link == leg.foot)
    if len(joints) < 2:
        return False
    hip, knee = (data.xanchor[model.joint(name).id] for name in joints[:2])
    last = joints[2] if len(joints) > 2 else None
    end = data.xanchor[model.joint(last).id] if last else _sole_world(model, data, foot)
    share = (hip[2] - knee[2]) / max(hip[2] - end[2], 1e-6)
    ahead = knee[0] - hip[0] - share * (end[0] - hip[0])
    return bool(anatomy.front.value * ahead > 0.0)


def _clipped_zero(model: mujoco.MjModel) -> dict[str, float]:
    """Return `qpos0`, moved into the ranges with a margin."""
    pose = {}
    for joint in geo.joint_ids(model):
        low, high = geo.joint_range(model, joint)
        zero = float(model.qpos0[model.jnt_qposadr[joint]])
        slack = MARGIN * (high - low) if not low < zero < high else 0.0
        pose[model.joint(joint).name] = float(np.clip(zero, low + slack, high - slack))
    return pose


def _sole_world(model: mujoco.MjModel, data: mujoco.MjData, foot: Foot) -> np.ndarray:
    link = model.body(foot.link).id
    return data.xpos[link] + data.xmat[link].reshape(3, 3) @ np.array(foot.position)


def _sole_position(
    model: mujoco.MjModel, data: mujoco.MjData, anatomy: Anatomy, foot: Foot
) -> np.ndarray:
    """Return the middle of the sole from the trunk's origin, (3,), world axes."""
    return _sole_world(model, data, foot) - data.xpos[model.body(anatomy.trunk.value).id]


def over_soles(model: mujoco.MjModel, data: mujoco.MjData, anatomy: Anatomy) -> bool:
    """Return True if the center of mass is above the convex hull of the soles, or nearly so."""
    points = np.vstack([sole_points(model, data, foot) for foot in anatomy.feet.value])
    com = data.subtree_com[model.body(anatomy.trunk.value).id]
    slack = OVER_SOLES * float(com[2] - points[:, 2].min())
    points, com = points[:, :2], com[:2]
    try:
        hull = ConvexHull(points)
    except QhullError:
        inside = (points.min(axis=0) - slack <= com) & (com <= points.max(axis=0) + slack)
        return bool(inside.all())
    return bool((hull.equations[:, :2] @ com + hull.equations[:, 2] < slack).all())


def _feet_mirrored(data: mujoco.MjData, model: mujoco.MjModel, anatomy: Anatomy) -> bool:
    """Return True if the feet in order are mirror images of each other, left and right."""
    at = np.array([_sole_position(model, data, anatomy, foot) for foot in anatomy.feet.value])
    image = at * np.array([1.0, -1.0, 1.0])
    size = float(np.ptp(at, axis=0).max())
    nearest = np.linalg.norm(at[:, None] - image[None], axis=2).min(axis=1)
    return bool((nearest < 0.1 * size).all())
