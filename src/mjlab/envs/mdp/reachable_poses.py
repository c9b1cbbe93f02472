"""Poses that a frame, such as a hand, can reach: forward kinematics of random joint positions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
import torch

from mjlab.utils.lab_api.math import quat_from_matrix, quat_unique
from mjlab.utils.mujoco import moving_dofs

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.frames import Frame

# Draws per pose before giving up. Of the YAM's, UR5e's and Panda's draws, a half to four fifths are
# free of contact.
_MAX_DRAWS = 50


class ReachablePoses(NamedTuple):
    """Poses, and the joint positions at which they were found."""

    poses: torch.Tensor
    """Poses of the frame in the root frame of its entity, (count, 7): position, quaternion."""
    joint_pos: torch.Tensor
    """Positions of the joints that move the frame, (count, joints) (rad or m)."""
    joint_ids: torch.Tensor
    """Columns of these joints in the entity's joint data, (joints,)."""
    turns: torch.Tensor
    """True for joints that can turn by 2 pi or more, so that the pose has several positions, (joints,)."""


def draw_reachable_poses(
    env: ManagerBasedRlEnv, entity: Entity, frame: Frame, count: int, fraction: float
) -> ReachablePoses:
    """Draw poses of `frame`.

    Joints between root and frame are drawn uniformly from the middle `fraction` of their ranges, at most
    half a turn from their default positions; all others stand at these. Poses are rejected if they put
    the entity in contact, unless the same two geoms touch in the default pose.

    Raises:
        ValueError: no joint moves the frame, or hardly a pose is free of contact.
    """
    model = env.sim.mj_model
    data = mujoco.MjData(model)
    home = default_qpos(env)
    columns = _joints_of(model, entity, frame.body)
    joints = entity.indexing.joint_ids.cpu().numpy()[columns]
    adr = model.jnt_qposadr[joints]
    low, high, turns = joint_bounds(model, joints, fraction, home[adr])
    bodies = np.zeros(model.nbody, dtype=bool)
    bodies[entity.indexing.body_ids.cpu().numpy()] = True
    data.qpos[:] = home
    allowed = _touching(model, data, bodies)
    root = entity.indexing.root_body_id
    # From torch's generator, which the seed of the run governs.
    seed = int(torch.randint(2**31, (1,)))
    rng = np.random.default_rng(seed)
    poses, positions = np.empty((count, 12)), np.empty((count, len(joints)))
    found = 0
    for _ in range(_MAX_DRAWS * count):
        data.qpos[adr] = rng.uniform(low, high)
        if _touching(model, data, bodies) <= allowed:
            poses[found], positions[found] = _pose_in_root(data, root, frame), data.qpos[adr]
            found += 1
            if found == count:
                break
    else:
        raise ValueError(
            f"Reachable poses: expected {count} joint positions without contact in "
            f"{_MAX_DRAWS * count} draws, got {found}; set ranges, or change joint_range_fraction."
        )
    rotation = torch.as_tensor(poses[:, 3:]).view(-1, 3, 3)
    position = torch.as_tensor(poses[:, :3])
    drawn = torch.cat((position, quat_unique(quat_from_matrix(rotation))), dim=1)
    return ReachablePoses(
        drawn.to(env.device, torch.float32),
        torch.as_tensor(positions, dtype=torch.float32, device=env.device),
        torch.as_tensor(columns, device=env.device),
        torch.as_tensor(turns, device=env.device),
    )


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
    model: mujoco.MjModel, joints: np.ndarray, fraction: float, home: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bounds (low, high) of the middle `fraction` of joint ranges, and where joints can turn.

    Joints that can turn by 2 pi or more have bounds of at most half a turn from `home`, which give the
    same poses.
    """
    limited = model.jnt_limited[joints].astype(bool)
    low, high = model.jnt_range[joints].T
    middle, half = 0.5 * (low + high), 0.5 * fraction * (high - low)
    is_wide = ~limited | (high - low >= 2.0 * math.pi)
    half_turn = np.where(is_wide, math.pi, np.inf)
    low = np.maximum(np.where(limited, middle - half, -np.inf), home - half_turn)
    high = np.minimum(np.where(limited, middle + half, np.inf), home + half_turn)
    return low, high, is_wide & (model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE)


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


def _pose_in_root(data: mujoco.MjData, root: int, frame: Frame) -> np.ndarray:
    """Return position and rotation matrix of a frame in the frame of the root body, (12,)."""
    positions, rotations = {
        "body": (data.xpos, data.xmat),
        "site": (data.site_xpos, data.site_xmat),
        "geom": (data.geom_xpos, data.geom_xmat),
    }[frame.frame_type]
    base = data.xmat[root].reshape(3, 3)
    position = base.T @ (positions[frame.element] - data.xpos[root])
    rotation = base.T @ rotations[frame.element].reshape(3, 3)
    return np.concatenate((position, rotation.ravel()))
