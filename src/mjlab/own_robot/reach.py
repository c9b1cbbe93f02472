"""Home pose and stand of an arm."""

from __future__ import annotations

import mujoco
import numpy as np

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import Anatomy, candidate_poses
from mjlab.own_robot.guess import JointGuess, Question

MIDDLE_SHARE = 0.8
"""Middle share of each joint's range that poses are drawn from, as the goals of pose commands are."""
HANGING = 0.1
"""Depth of a geom below the base at `qpos0` from which on an arm hangs (m)."""
STAND_CLEARANCE = 0.1
"""Distance of a hanging arm to the ground (m)."""
TURN_LENGTH = 0.15
"""Displacement of the hand that counts as a turn of 1 rad (m/rad): the goals' tolerances, 5 cm and 0.35 rad."""
HOME_DRAWS = 400
"""Number of poses among which an arm's home is searched."""


def arm_home(
    model: mujoco.MjModel,
    anatomy: Anatomy,
    answers: dict[str, float] | None = None,
) -> tuple[JointGuess, list[Question]]:
    """Return the home pose of an arm: a keyframe without contact, else a searched one."""
    answers = answers or {}
    data = mujoco.MjData(model)
    joints = geo.joint_ids(model)
    is_free = _FreeOfContact(model)
    for name, qpos in candidate_poses(model):
        pose = {model.joint(j).name: float(qpos[model.jnt_qposadr[j]]) for j in joints}
        geo.set_pose(model, data, pose)
        inside = all(
            low - 1e-3 <= pose[model.joint(j).name] <= high + 1e-3
            for j in joints
            for low, high in [geo.joint_range(model, j)]
        )
        if name != "zero pose" and inside and is_free(data):
            rule = f"{name}: inside limits, no contact"
            return JointGuess.of(pose, rule, "file").answered(answers), []
    pose = _searched_home(model, anatomy, is_free, answers)
    pose = {name: round(position, 3) + 0.0 for name, position in pose.items()}
    rule = "no keyframe: close to the middle of the ranges, bent for dexterity"
    home = JointGuess.of(pose, rule, "asked").answered(answers)
    if pose.keys() <= answers.keys():
        return home, []
    used = ", ".join(f"{position:g}" for position in pose.values())
    text = f"home of the arm, joint by joint ({', '.join(pose)}): no keyframe"
    return home, [Question("pose", text, used)]


def stand_height(model: mujoco.MjModel, anatomy: Anatomy) -> float:
    """Return the height of the base at which a hanging arm clears the ground, 0 for a standing arm (m)."""
    data = mujoco.MjData(model)
    geo.set_pose(model, data, {})
    lowest = geo.lowest_height(model, data, [model.geom(g).id for g in anatomy.colliding.value])
    return round(STAND_CLEARANCE - lowest, 2) if lowest < -HANGING else 0.0


def _searched_home(
    model: mujoco.MjModel,
    anatomy: Anatomy,
    is_free: _FreeOfContact,
    answers: dict[str, float],
) -> dict[str, float]:
    """Return the pose closest to the middle of the ranges among those that are dexterous.

    Dexterity is the smallest singular value of the hand's Jacobian, of rotations times `TURN_LENGTH`: 0 for a
    stretched arm, and for a wrist with two parallel axes. At least 70 % of the largest of all draws is asked
    for; then joints return to the middle one by one.
    """
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    hangs = stand_height(model, anatomy) > 0.0
    middle = {}
    for joint in geo.joint_ids(model):
        low, high = geo.joint_range(model, joint)
        # A hanging arm rests at zero; others at the middle of their ranges.
        rest = float(model.qpos0[model.jnt_qposadr[joint]]) if hangs else 0.5 * (low + high)
        slack = 0.5 * (1.0 - MIDDLE_SHARE) * (high - low)
        middle[model.joint(joint).name] = float(np.clip(rest, low + slack, high - slack))
    middle |= answers
    if not anatomy.hands.value:
        return middle
    hand, mirror = anatomy.hands.value[0], anatomy.mirror.value
    dofs = [int(model.jnt_dofadr[model.joint(name).id]) for name in hand.joints]
    link, jacobian = model.body(hand.link).id, np.zeros((6, model.nv))
    geoms = [model.geom(name).id for name in anatomy.colliding.value]
    # Poses of an arm on the ground stay above it.
    floor = -np.inf if hangs else -0.01

    def measure(angles: dict[str, float]) -> tuple[dict[str, float], float, bool]:
        """Return the pose of both arms, its dexterity, and True if it is above the ground."""
        images = {mirror[n][0]: mirror[n][1] * q for n, q in angles.items() if n in mirror}
        pose = middle | images | angles | answers
        geo.set_pose(model, data, pose)
        if not is_free(data):
            return pose, 0.0, False
        point = data.xpos[link] + data.xmat[link].reshape(3, 3) @ np.array(hand.position)
        mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], point, link)
        jacobian[3:] *= TURN_LENGTH
        dexterity = float(np.linalg.svd(jacobian[:, dofs], compute_uv=False)[-1])
        return pose, dexterity, geo.lowest_height(model, data, geoms) > floor

    def distance(angles: dict[str, float]) -> float:
        return float(np.linalg.norm([angles[name] - middle[name] for name in hand.joints]))

    drawn = [_draw(model, hand.joints, rng) for _ in range(HOME_DRAWS)]
    measured = [(angles, *measure(angles)[1:]) for angles in drawn]
    above = [item for item in measured if item[2]]
    kept = above or measured
    enough = 0.7 * max(dexterity for _, dexterity, _ in kept)
    good = [angles for angles, dexterity, _ in kept if dexterity >= enough]
    angles = min(good, key=distance)
    for name in hand.joints:
        trial = angles | {name: middle[name]}
        _, dexterity, is_above = measure(trial)
        if dexterity >= enough and (is_above or not above):
            angles = trial
    return measure(angles)[0]


def _draw(
    model: mujoco.MjModel, joints: tuple[str, ...], rng: np.random.Generator
) -> dict[str, float]:
    """Return positions in the middle of each joint's range, of wide ranges within a turn."""
    drawn = {}
    for name in joints:
        low, high = geo.joint_range(model, model.joint(name).id)
        half = min(np.pi, 0.5 * (high - low)) * MIDDLE_SHARE
        drawn[name] = float(rng.uniform(0.5 * (low + high) - half, 0.5 * (low + high) + half))
    return drawn


class _FreeOfContact:
    """Test of poses for contacts, without those that the model has in all poses."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        rng, data = np.random.default_rng(0), mujoco.MjData(model)
        names = tuple(model.joint(j).name for j in geo.joint_ids(model))
        touching = []
        for _ in range(20):
            geo.set_pose(model, data, _draw(model, names, rng))
            mujoco.mj_collision(model, data)
            touching.append(self._pairs(data))
        self._always = set.intersection(*touching)

    def __call__(self, data: mujoco.MjData) -> bool:
        """Return True if the pose of `data` has no contact."""
        mujoco.mj_collision(self._model, data)
        return self._pairs(data) <= self._always

    @staticmethod
    def _pairs(data: mujoco.MjData) -> set[tuple[int, int]]:
        return {(int(a), int(b)) for a, b in data.contact.geom[: data.ncon]}
