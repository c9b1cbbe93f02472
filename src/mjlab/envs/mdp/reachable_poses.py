"""Poses that a frame, such as a hand, can reach: forward kinematics of random joint positions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
import torch

from mjlab.envs.mdp.actions.differential_ik import damped_least_squares
from mjlab.utils.lab_api.math import (
    compute_pose_error,
    quat_apply,
    quat_from_angle_axis,
    quat_from_matrix,
    quat_mul,
)
from mjlab.utils.mujoco import moving_dofs

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.frames import Frame

# Draws per pose before giving up. Of the YAM's, UR5e's and Panda's draws, a half to four fifths are
# free of contact.
_MAX_DRAWS = 50

# Inverse kinematics from home: 96 to 99 % of the goals of YAM, UR5e, Panda, xArm7 and OpenArm are found.
_IK_STEPS = 40
_MAX_STEP = 0.3
"""Greatest motion of a joint in a step (rad, m)."""
_DAMPING = 0.05
"""Damping of joint motion (m/rad)."""
_HOME_PULL = 0.01
"""Squared weight of the distance from home, which resolves redundancy; 0 in the second half of the steps."""
_TURN_LENGTH = 0.3
"""Displacement that counts as a turn of 1 rad (m/rad)."""
_SOLUTION_TURN = 1.9
"""Greatest distance of a hinge from home in a solution (rad): a little more than of those drawn."""
_FOUND = (0.01, 0.05)
"""Errors of a pose that is found (m, rad)."""

QUARTER_TURN = 0.5 * math.pi
"""Greatest distance of a hinge from its default position at a goal (rad)."""


class ReachablePoses(NamedTuple):
    """Poses, and joint positions at which the frame has them."""

    poses: torch.Tensor
    """Poses of the frame in the root frame of its entity, (count, 7): position, quaternion, with the sign that is
    closer to `home_quat`."""
    joint_pos: torch.Tensor
    """Positions of the joints that move the frame, (count, joints) (rad or m). Of several solutions, the one
    that inverse kinematics leads to from the default positions."""
    joint_ids: torch.Tensor
    """Columns of these joints in the entity's joint data, (joints,)."""
    torque: torch.Tensor
    """Torques that hold the joints at `joint_pos` against gravity, (count, joints) (N m or N)."""
    jacobian: torch.Tensor
    """Motion of the frame per motion of each joint at `joint_pos`, in the root frame, (count, 6, joints):
    translation, rotation."""
    home_quat: torch.Tensor
    """Orientation of the frame in the default pose, (4,)."""


def draw_reachable_poses(
    env: ManagerBasedRlEnv, entity: Entity, frame: Frame, count: int, fraction: float
) -> ReachablePoses:
    """Draw poses of `frame`.

    Joints between root and frame are drawn uniformly within `joint_bounds`; all others stand at their default
    positions. Poses are rejected if they put the entity in contact, unless the same two geoms touch in the
    default pose.

    Raises:
        ValueError: no joint moves the frame, or hardly a pose is free of contact.
    """
    model = env.sim.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = default_qpos(env)
    columns = _joints_of(model, entity, frame.body)
    joints = entity.indexing.joint_ids.cpu().numpy()[columns]
    adr = model.jnt_qposadr[joints]
    bodies = np.zeros(model.nbody, dtype=bool)
    bodies[entity.indexing.body_ids.cpu().numpy()] = True
    allowed = _touching(model, data, bodies)
    chain = _Chain(data, entity.indexing.root_body_id, frame, joints)
    low, high = joint_bounds(model, joints, fraction, data.qpos[adr])
    inside = joint_bounds(model, joints, 0.5 * (1.0 + fraction), data.qpos[adr], _SOLUTION_TURN)
    # From torch's generator, which the seed of the run governs.
    seed = int(torch.randint(2**31, (1,)))
    rng = np.random.default_rng(seed)
    positions = np.empty((count, len(joints)))
    found = 0
    for _ in range(_MAX_DRAWS * count):
        data.qpos[adr] = rng.uniform(low, high)
        if _touching(model, data, bodies) <= allowed:
            positions[found] = data.qpos[adr]
            found += 1
            if found == count:
                break
    else:
        raise ValueError(
            f"Reachable poses: expected {count} joint positions without contact in "
            f"{_MAX_DRAWS * count} draws, got {found}; set ranges, or change joint_range_fraction."
        )
    position, quat, _ = chain.forward(torch.as_tensor(positions))
    goals = torch.cat((position, quat_near(quat, chain.home_quat)), dim=1)
    near, is_found = _solve_from_home(chain, goals, inside)
    torques = np.empty_like(positions)
    for index, is_near in enumerate(is_found):
        data.qpos[adr] = near[index]
        if is_near and _touching(model, data, bodies) <= allowed:
            positions[index] = near[index]
        data.qpos[adr] = positions[index]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        torques[index] = (data.qfrc_bias - data.qfrc_passive)[model.jnt_dofadr[joints]]
    return ReachablePoses(
        goals.to(env.device, torch.float32),
        torch.as_tensor(positions, dtype=torch.float32, device=env.device),
        torch.as_tensor(columns, device=env.device),
        torch.as_tensor(torques, dtype=torch.float32, device=env.device),
        chain.forward(torch.as_tensor(positions))[2].to(env.device, torch.float32),
        chain.home_quat.to(env.device, torch.float32),
    )


def quat_near(quat: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """Return quaternions (N, 4) with the sign that is closer to `reference` (4,).

    With w >= 0 instead, the signs of goals around a hand that points down, w = 0, are random: of half of the
    goals of Panda and xArm7.
    """
    return torch.where((quat * reference).sum(dim=-1, keepdim=True) < 0.0, -quat, quat)


class _Chain:
    """Kinematics of a frame that joints move, in the frame of a root body, for many joint positions at once.

    By the product of exponentials: each joint turns or shifts all that it carries about its axis in the
    default pose.
    """

    def __init__(self, data: mujoco.MjData, root: int, frame: Frame, joints: np.ndarray) -> None:
        """Read axes, anchors and the frame's pose from `data`, in the default pose."""
        model = data.model
        positions, rotations = {
            "body": (data.xpos, data.xmat),
            "site": (data.site_xpos, data.site_xmat),
            "geom": (data.geom_xpos, data.geom_xmat),
        }[frame.frame_type]
        base = torch.tensor(data.xmat[root]).view(3, 3)
        origin = torch.tensor(data.xpos[root])

        def in_root(points: np.ndarray) -> torch.Tensor:
            return (torch.tensor(points) - origin) @ base

        self.home = torch.tensor(data.qpos[model.jnt_qposadr[joints]])
        self.home_pos = in_root(positions[frame.element])
        self.home_quat = quat_from_matrix(
            base.T @ torch.tensor(rotations[frame.element]).view(3, 3)
        )
        self._axes = torch.tensor(data.xaxis[joints]) @ base
        self._anchors = in_root(data.xanchor[joints])
        self._is_hinge = (model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE).tolist()

    def forward(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return position, (N, 3), quaternion, (N, 4), and Jacobian, (N, 6, joints), at `q`, (N, joints)."""
        size = (len(q), 3)
        # Motion of the links so far from the default pose: a point x moves to turn x + shift.
        turn, shift = torch.eye(1, 4, dtype=q.dtype).repeat(len(q), 1), q.new_zeros(size)
        axes, anchors = [], []
        for column, motion in enumerate((q - self.home).T):
            axis, anchor = self._axes[column].expand(size), self._anchors[column].expand(size)
            axes.append(quat_apply(turn, axis))
            anchors.append(quat_apply(turn, anchor) + shift)
            if self._is_hinge[column]:
                turn = quat_mul(turn, quat_from_angle_axis(motion, axis))
                shift = anchors[-1] - quat_apply(turn, anchor)
            else:
                shift = shift + motion.unsqueeze(1) * axes[-1]
        position = quat_apply(turn, self.home_pos.expand(size)) + shift
        columns = [
            torch.cat((torch.linalg.cross(axis, position - anchor), axis), dim=1)
            if is_hinge
            else torch.cat((axis, torch.zeros_like(axis)), dim=1)
            for axis, anchor, is_hinge in zip(axes, anchors, self._is_hinge, strict=True)
        ]
        quat = quat_mul(turn, self.home_quat.expand(len(q), 4))
        return position, quat, torch.stack(columns, dim=2)


def _solve_from_home(
    chain: _Chain, goals: torch.Tensor, bounds: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions at goals, (count, joints), and True where they were found, (count,).

    Damped least squares from the default pose, with joints that would pass a bound held there. An arm
    has up to eight joint positions per pose, with a redundant joint infinitely many: a policy cannot learn
    which one was drawn.
    """
    low, high = (torch.as_tensor(bound) for bound in bounds)
    weights = torch.tensor([1.0] * 3 + [_TURN_LENGTH] * 3, dtype=torch.float64).unsqueeze(1)
    q = chain.home.repeat(len(goals), 1)
    for step in range(_IK_STEPS + 1):
        position, quat, jacobian = chain.forward(q)
        error = torch.cat(compute_pose_error(position, quat, goals[:, :3], goals[:, 3:]), dim=1)
        if step == _IK_STEPS:
            break
        pull = _HOME_PULL if step < _IK_STEPS / 2 else 0.0
        stiffness = torch.full_like(q, _DAMPING**2 + pull)
        is_free = torch.ones_like(q, dtype=torch.bool)
        for _ in range(2):
            rows = weights * jacobian * is_free.unsqueeze(1)
            toward = pull * (chain.home - q) * is_free
            dq = damped_least_squares(rows, weights[:, 0] * error, stiffness, toward)
            dq *= _MAX_STEP / dq.abs().amax(dim=1, keepdim=True).clamp(min=_MAX_STEP)
            is_free &= (q + dq >= low) & (q + dq <= high)
        q = torch.clamp(q + dq, low, high)
    is_found = (error[:, :3].norm(dim=1) < _FOUND[0]) & (error[:, 3:].norm(dim=1) < _FOUND[1])
    return q.numpy(), is_found.numpy()


def default_qpos(env: ManagerBasedRlEnv) -> np.ndarray:
    """Return the default positions of all entities of the first environment, (nq,)."""
    qpos = env.sim.mj_model.qpos0.copy()
    for entity in env.scene.entities.values():
        ix, data = entity.indexing, entity.data
        if len(ix.free_joint_q_adr):
            root = data.default_root_state[0, :7].clone()
            root[:3] += env.scene.env_origins[0]
            qpos[ix.free_joint_q_adr.cpu().numpy()] = root.cpu().numpy()
        if entity.is_articulated:
            qpos[ix.joint_q_adr.cpu().numpy()] = data.default_joint_pos[0].cpu().numpy()
    return qpos


def joint_bounds(
    model: mujoco.MjModel,
    joints: np.ndarray,
    fraction: float,
    home: np.ndarray,
    largest_turn: float = QUARTER_TURN,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds (low, high) of the middle `fraction` of joint ranges, of hinges near `home`.

    Hinges turn at most by `largest_turn`. With more, elbows and wrists flip, and a pose has joint positions that
    no continuous motion connects with `home`.
    """
    limited = model.jnt_limited[joints].astype(bool)
    low, high = model.jnt_range[joints].T
    middle, half = 0.5 * (low + high), 0.5 * fraction * (high - low)
    is_hinge = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE
    turn = np.where(is_hinge, largest_turn, np.inf)
    low = np.maximum(np.where(limited, middle - half, -np.inf), home - turn)
    high = np.minimum(np.where(limited, middle + half, np.inf), home + turn)
    return low, high


def _joints_of(model: mujoco.MjModel, entity: Entity, body: int) -> np.ndarray:
    """Return the columns, in the entity's joint data, of its hinges and slides that move a body."""
    moves = moving_dofs(model)[body]
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = [
        column
        for column, joint in enumerate(entity.indexing.joint_ids.tolist())
        if int(model.jnt_type[joint]) in scalar and moves[model.jnt_dofadr[joint]]
    ]
    if not joints:
        name = model.body(body).name
        raise ValueError(f"Reachable poses: expected a frame moved by joints, got one on {name!r}.")
    return np.array(joints)


def _touching(
    model: mujoco.MjModel, data: mujoco.MjData, bodies: np.ndarray
) -> set[tuple[int, int]]:
    """Move the bodies to `data.qpos`; return the pairs of geoms in contact, one of `bodies`' or both."""
    mujoco.mj_fwdPosition(model, data)
    contacts = data.contact
    ours = bodies[model.geom_bodyid[contacts.geom]].any(axis=1) & (contacts.dist < 0.0)
    return {(one, other) for one, other in contacts.geom[ours].tolist()}
