"""Commands and joint ranges of walking, from the size of the legs.

Robots of different size walk alike at equal Froude number v^2 / (g h) with h the height of the trunk, so
speeds scale with sqrt(h), turning rates with 1/sqrt(h), and strides with h.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.optimize import least_squares

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, Foot, Leg, like_joints
from mjlab.own_robot.guess import Guess, JointGuess, Reason

REFERENCE_HEIGHT = {2: 0.76, 4: 0.28}
"""Height of the trunk of the G1 and Go1, by number of feet, which are commanded 1 m/s (m)."""
TURNING = {2: 1.0, 4: 0.5}
"""Commanded yaw rate at these heights (rad/s). Two legs sway by 0.3 rad/s with their steps, which hides turns
of 0.5 rad/s; 1 rad/s is that of published humanoid tasks (MuJoCo Playground's T1 and G1)."""
STRIDE = {2: 0.23, 4: 0.36}
"""Travel of a foot ahead of and behind its place in the standing pose, as a share of the height: 0.17 m of
the G1, 0.10 m of the Go1, at 1 m/s."""
LIFT = {2: 0.13, 4: 0.36}
"""Height of a swinging foot, as a share of the trunk's: 0.1 m of both."""
TURN = 0.2
"""Yaw of a foot ahead of and behind the standing pose (rad): 0.5 rad/s for 0.4 s, 1 rad/s for 0.2 s."""
SPREAD = 0.8
"""Tolerance of a leg joint, a standard deviation, as a share of the largest excursion."""
MIN_TOLERANCE, MAX_TOLERANCE = 0.1, 0.6
"""Smallest and largest tolerance of a leg joint (rad)."""
REST_TOLERANCE = 0.15
"""Tolerance of joints outside the legs (rad)."""


def command_ranges(height: float, feet: int) -> Guess[dict[str, tuple[float, float]]]:
    """Return the ranges of velocity commands at the Froude number of the Go1 or G1."""
    legs = 2 if feet == 2 else 4
    reference = REFERENCE_HEIGHT[legs]
    speed = float(np.sqrt(max(height, 1e-3) / reference))
    turn = TURNING[legs] / speed
    ranges = {
        "lin_vel_x": (-speed, speed),
        "lin_vel_y": (-speed, speed),
        "ang_vel_z": (-turn, turn),
    }
    model = "G1" if feet == 2 else "Go1"
    rule = f"speed of the {model} for its size: 1 m/s x sqrt(height / {reference} m)"
    return Guess(ranges, rule)


def lift(height: float, feet: int) -> float:
    """Return the height of a swinging foot (m), for a robot with its trunk at `height`."""
    return LIFT[2 if feet == 2 else 4] * height


def pose_tolerance(
    model: mujoco.MjModel, anatomy: Anatomy, joint_pos: dict[str, float], height: float
) -> JointGuess:
    """Return the tolerance of each joint around the standing pose that strides need (rad)."""
    tolerance = dict.fromkeys(joint_pos, REST_TOLERANCE)
    reasons = dict.fromkeys(joint_pos, Reason("outside the legs"))
    feet = 2 if len(anatomy.feet.value) == 2 else 4
    stride, up = STRIDE[feet] * height, lift(height, feet)
    moves = np.array(
        [
            (stride, 0, 0, 0),
            (-stride, 0, 0, 0),
            (0, 0.5 * stride, 0, 0),
            (0, -0.5 * stride, 0, 0),
            (0, 0, up, 0),
            (0, 0, 0, TURN),
            (0, 0, 0, -TURN),
        ]
    )
    mirror = anatomy.mirror.value
    done: set[str] = set()
    for leg, foot in zip(anatomy.legs.value, anatomy.feet.value, strict=True):
        if done.issuperset(leg.joints):
            continue
        home = np.array([joint_pos[name] for name in leg.joints])
        excursions = np.array(
            [step(model, leg, foot, joint_pos, move[:3], move[3]) - home for move in moves]
        )
        spread = SPREAD * np.abs(excursions).max(axis=0)
        largest = np.clip(spread, MIN_TOLERANCE, MAX_TOLERANCE)
        for name, value in zip(leg.joints, largest, strict=True):
            partner, _ = mirror.get(name, (name, 1.0))
            done |= {name, partner}
            tolerance[name] = tolerance[partner] = round(float(value), 2)
    rule = f"{SPREAD:g} of what strides of {stride:.2f} m and lifts of {up:.2f} m need"
    reasons |= dict.fromkeys(anatomy.leg_joints, Reason(rule))
    return JointGuess(tolerance, reasons).alike(like_joints(anatomy, joint_pos))


def step(
    model: mujoco.MjModel,
    leg: Leg,
    foot: Foot,
    joint_pos: dict[str, float],
    offset: np.ndarray,
    yaw: float = 0.0,
) -> np.ndarray:
    """Return the joint positions of a leg that move its foot from where it stands, (J,).

    Least squares on the position of the sole, its tilt and its yaw, close to the standing pose.

    Args:
        model: Robot.
        leg: Leg.
        foot: Foot of the leg.
        joint_pos: Standing pose.
        offset: Displacement of the foot in the frame of the trunk (m).
        yaw: Turn of the foot (rad).
    """
    data, link = mujoco.MjData(model), model.body(foot.link).id
    local = np.array(foot.position)
    geo.set_pose(model, data, joint_pos)
    rotation = data.xmat[link].reshape(3, 3).copy()
    target = data.xpos[link] + rotation @ local + offset
    length = float(np.linalg.norm(target - data.xanchor[model.joint(leg.joints[0]).id]))
    home = np.array([joint_pos[name] for name in leg.joints])
    ranges = np.array([geo.joint_range(model, model.joint(name).id) for name in leg.joints])
    low, high = ranges[:, 0] - 1e-6, ranges[:, 1] + 1e-6
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    wanted = turn @ rotation
    # A leg of three joints cannot keep its foot level.
    level = 0.3 if len(leg.joints) > 3 else 0.0

    addresses = geo.qpos_addresses(model, leg.joints)

    def residual(angles: np.ndarray) -> np.ndarray:
        data.qpos[addresses] = angles
        mujoco.mj_kinematics(model, data)
        actual = data.xmat[link].reshape(3, 3)
        error = (data.xpos[link] + actual @ local - target) / length
        return np.concatenate([error, level * (actual - wanted).ravel(), 0.02 * (angles - home)])

    result = least_squares(residual, np.clip(home, low, high), bounds=(low, high), max_nfev=30)
    return result.x
