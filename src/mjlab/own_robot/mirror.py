"""Mirror image of a robot, left to right, from the geometry of its joints.

Joint j turns about the line through anchor p with axis a, in the trunk's frame at `qpos0`. With the
reflection M = diag(1, -1, 1), its partner turns about a line through M p with an axis b parallel to M a,
and the links that it moves have their center of mass c at M c. A motion q of a hinge is that of an axial
vector, so the partner moves by s q with

    s = sign(b . (-M a)),    of a slide    s = sign(b . M a).
"""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo

LINE_TOLERANCE = 0.02
"""Distance of a joint's line to the mirror image of its partner's, as a share of the robot's size."""
MASS_TOLERANCE = 0.06
"""Distance of the centers of mass of moved links, as a share of the robot's size: identified inertias and
mounted computers differ left and right."""
AXIS_TOLERANCE = 0.95
"""Cosine between an axis and the mirror image of its partner's."""
RANGE_TOLERANCE = 0.25
"""Difference of the ends of the ranges of a pair (rad)."""

_REFLECTION = np.array([1.0, -1.0, 1.0])


def mirror_pairs(model: mujoco.MjModel, trunk: int) -> dict[str, tuple[str, float]]:
    """Return the partner of each hinge and slide, and the sign of its motion.

    A joint in the mirror plane is its own partner. Joints without a partner are left out. The result
    is an involution: the partner's partner is the joint, with the same sign.

    Args:
        model: Robot.
        trunk: Body whose x-z plane is the mirror plane; 0, the world, for arms.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    origin, rotation = data.xpos[trunk], data.xmat[trunk].reshape(3, 3)
    anchors = (data.xanchor - origin) @ rotation  # (J, 3)
    axes = data.xaxis @ rotation  # (J, 3)
    masses = (data.subtree_com[model.jnt_bodyid] - origin) @ rotation  # (J, 3)
    joints = geo.joint_ids(model)
    if trunk:
        joints = [j for j in joints if trunk in _ancestors(model, int(model.jnt_bodyid[j]))]
    size = max(
        (float(np.ptp(points[joints], axis=0).max()) for points in (anchors, masses) if joints),
        default=0.0,
    )
    costs: list[tuple[float, float, int, int]] = []
    for first, second in itertools.combinations_with_replacement(joints, 2):
        cost = _mismatch(model, anchors, axes, masses, first, second, size)
        if cost is not None:
            names = model.joint(first).name, model.joint(second).name
            costs.append((round(cost, 3), -_name_likeness(*names), first, second))
    partner: dict[int, int] = {}
    for _, _, first, second in sorted(costs):
        if first not in partner and second not in partner:
            partner[first], partner[second] = second, first
    return {
        model.joint(j).name: (model.joint(p).name, _sign(model, axes, j, p))
        for j, p in partner.items()
    }


def mirror_pose(
    pairs: dict[str, tuple[str, float]], joint_pos: dict[str, float]
) -> dict[str, float]:
    """Return the mirror image of joint positions measured from `qpos0`."""
    return {
        pairs[name][0]: pairs[name][1] * position
        for name, position in joint_pos.items()
        if name in pairs
    }


def _ancestors(model: mujoco.MjModel, body: int) -> set[int]:
    found = {body}
    while body:
        body = int(model.body_parentid[body])
        found.add(body)
    return found


def _mismatch(
    model: mujoco.MjModel,
    anchors: np.ndarray,
    axes: np.ndarray,
    masses: np.ndarray,
    i: int,
    j: int,
    size: float,
) -> float | None:
    """Return the mismatch of two joints as mirror images; None if they are none."""
    if model.jnt_type[i] != model.jnt_type[j] or _depth(model, i) != _depth(model, j):
        return None
    along = abs(float(np.dot(axes[i] * _REFLECTION, axes[j])))
    between = anchors[i] * _REFLECTION - anchors[j]
    # An anchor may lie anywhere along its axis.
    line = float(np.linalg.norm(np.cross(between, axes[j]))) / size
    mass = float(np.linalg.norm(masses[i] * _REFLECTION - masses[j])) / size
    if along < AXIS_TOLERANCE or line > LINE_TOLERANCE or mass > MASS_TOLERANCE:
        return None
    ends = np.array(geo.joint_range(model, i)) - model.qpos0[model.jnt_qposadr[i]]
    image = np.sort(_sign(model, axes, i, j) * ends)
    other = np.array(geo.joint_range(model, j)) - model.qpos0[model.jnt_qposadr[j]]
    difference = float(np.abs(image - other).max())
    # A joint in the plane may have an uneven range: a waist with a stop on one side.
    if i != j and difference > RANGE_TOLERANCE * max(1.0, float(np.ptp(other))):
        return None
    return line + mass + (1.0 - along) + 0.01 * difference


def _sign(model: mujoco.MjModel, axes: np.ndarray, i: int, j: int) -> float:
    image = axes[i] * _REFLECTION * (-1.0 if model.jnt_type[i] == geo.HINGE else 1.0)
    return 1.0 if float(np.dot(image, axes[j])) > 0 else -1.0


def _depth(model: mujoco.MjModel, joint: int) -> int:
    """Return the number of joints above a joint, those before it on its body included."""
    body = int(model.jnt_bodyid[joint])
    above = joint - int(model.body_jntadr[body])
    while body := int(model.body_parentid[body]):
        above += int(model.body_jntnum[body])
    return above


def _name_likeness(first: str, second: str) -> float:
    """Return the share of equal characters from both ends of two names."""
    if first == second:
        return 1.0
    head = sum(1 for _ in itertools.takewhile(lambda p: p[0] == p[1], zip(first, second)))  # noqa: B905
    tail = sum(
        1
        for _ in itertools.takewhile(lambda p: p[0] == p[1], zip(first[::-1], second[::-1]))  # noqa: B905
    )
    return min(1.0, (head + tail) / max(len(first), len(second)))
