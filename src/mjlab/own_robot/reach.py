"""Home pose and reachable goals of an arm."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, Hand, candidate_poses
from mjlab.own_robot.guess import Guess, Question

GOAL_SHARE = 0.8
"""Middle share of each joint's range that goals are drawn from."""


@dataclass(frozen=True)
class HandPoses:
    """Poses of a hand, N of them."""

    joints: tuple[str, ...]
    """Joints of the arm."""
    joint_pos: np.ndarray
    """Joint positions, (N, J)."""
    positions: np.ndarray
    """Positions of the grasp in the frame of the base, (N, 3) (m)."""
    quaternions: np.ndarray
    """Orientations of the hand in the frame of the base, (N, 4), w first."""


def reachable_hand_poses(
    model: mujoco.MjModel,
    anatomy: Anatomy,
    hand: Hand,
    home: dict[str, float],
    count: int = 1000,
    ground: float | None = None,
    seed: int = 0,
) -> HandPoses:
    """Return hand poses of random joint positions without contact.

    Args:
        model: Robot.
        anatomy: Parts of the robot.
        hand: Hand to place.
        home: Positions of the other joints.
        count: Number of poses.
        ground: Height of the ground in the frame of the model that all geoms stay above (m); None
            without ground.
        seed: Seed of the random draws.
    """
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    joints = [model.joint(name).id for name in hand.joints]
    ranges = np.array([geo.joint_range(model, j) for j in joints])  # (J, 2)
    middle, half = ranges.mean(axis=1), GOAL_SHARE * np.ptp(ranges, axis=1) / 2.0
    geoms = [model.geom(name).id for name in anatomy.colliding.value]
    link = model.body(hand.link).id
    moving = [
        g for g in geoms if set(geo.chain(model, int(model.body_weldid[model.geom_bodyid[g]])))
    ]
    drawn, positions, quaternions = [], [], []
    for _ in range(50 * count):
        if len(drawn) == count:
            break
        angles = rng.uniform(middle - half, middle + half)
        geo.set_pose(model, data, home | dict(zip(hand.joints, map(float, angles), strict=True)))
        mujoco.mj_collision(model, data)
        if data.ncon or (ground is not None and geo.lowest_height(model, data, moving) < ground):
            continue
        rotation = data.xmat[link].reshape(3, 3)
        drawn.append(angles)
        positions.append(data.xpos[link] + rotation @ np.array(hand.position))
        quaternions.append(data.xquat[link].copy())
    return HandPoses(hand.joints, np.array(drawn), np.array(positions), np.array(quaternions))


def arm_home(
    model: mujoco.MjModel, anatomy: Anatomy, answers: dict[str, float] | None = None
) -> tuple[Guess[dict[str, float]], list[Question]]:
    """Return the home pose of an arm: a keyframe without contact, else the middle of the ranges."""
    answers = answers or {}
    data = mujoco.MjData(model)
    joints = geo.joint_ids(model)
    for name, qpos in candidate_poses(model):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        pose = {model.joint(j).name: float(qpos[model.jnt_qposadr[j]]) for j in joints}
        inside = all(
            low - 1e-3 <= pose[model.joint(j).name] <= high + 1e-3
            for j in joints
            for low, high in [geo.joint_range(model, j)]
        )
        if name != "zero pose" and inside and not data.ncon:
            if answers:
                return Guess(pose | answers, f"{name}, with answers", "set"), []
            return Guess(pose, f"{name}: inside limits, no contact", "file"), []
    pose = {model.joint(j).name: float(np.mean(geo.joint_range(model, j))) for j in joints}
    question = Question("pose", "home of the arm: no keyframe", "the middle of the ranges")
    if answers:
        return Guess(pose | answers, "as set; else the middle of the ranges", "set"), []
    return Guess(pose, "no keyframe: the middle of the ranges", "asked"), [question]
