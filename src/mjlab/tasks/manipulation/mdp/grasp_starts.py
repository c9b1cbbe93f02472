"""Training starts along the way of a lift: the object in the hand, or the arm in another posture.

From the registered start, closing the fingers is worth nothing until the hand is around the object, and
most of a training passes before chance brings it there. A goal that starts with the object between the
fingers shows at once what holding and carrying it is worth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

from mjlab.tasks.manipulation.mdp.commands import LiftingCommand, LiftingCommandCfg

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

__all__ = ["GraspStartsLiftingCommand", "GraspStartsLiftingCommandCfg", "grasp_postures"]

# Of the YAM's postures within half of the joint ranges, one of 40 has its hand over the table.
_MAX_DRAWS = 400_000


@dataclass(kw_only=True)
class GraspStartsLiftingCommandCfg(LiftingCommandCfg):
    """Configuration of a lifting command some of whose goals start along the way. For training.

    All other goals start as those of `LiftingCommand`.
    """

    robot_name: str
    """Name of the arm, an entity."""
    site_name: str
    """Site of the hand that is inside a held object. Its z axis points out of the hand."""
    fingers: dict[str, tuple[float, float]]
    """Positions of the finger joints by name: the first holds the object, the second is around it
    (rad or m). Starts are anywhere between."""
    in_hand: float = 0.4
    """Fraction of goals that start with the object at the site, in a posture of `grasp_postures`."""
    elsewhere: float = 0.2
    """Fraction of goals that start in such a posture with the object on the ground, as after a goal."""
    x: tuple[float, float] = (0.15, 0.5)
    """Range of the hand along x, relative to the environment's origin (m)."""
    y: tuple[float, float] = (-0.3, 0.3)
    """Range of the hand along y (m)."""
    z: tuple[float, float] = (0.035, 0.4)
    """Range of the hand along z (m)."""
    max_tilt: float = 0.9
    """Largest angle between the site's z axis and straight down (rad)."""
    joint_range: float = 0.5
    """Range of joint positions about the default, as a fraction of the joint limits' range."""
    num_postures: int = 1000
    """Number of postures to sample from."""

    def build(self, env: ManagerBasedRlEnv) -> GraspStartsLiftingCommand:
        """Build the term."""
        return GraspStartsLiftingCommand(self, env)


class GraspStartsLiftingCommand(LiftingCommand):
    """Goal for a single object that starts on the ground, or in the hand; see `LiftingCommand`.

    Raises `ValueError` if too few postures have the hand within the ranges.
    """

    # Derived from config and model; not checkpointed.
    _transient = LiftingCommand._transient | {"_joint_pos", "_hand_pose", "_fingers"}

    cfg: GraspStartsLiftingCommandCfg  # ty: ignore[incompatible-mutable-override]

    def __init__(self, cfg: GraspStartsLiftingCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self.robot: Entity = env.scene[cfg.robot_name]
        postures = grasp_postures(env.sim.mj_model, self.robot, cfg)
        self._joint_pos, self._hand_pose = (
            torch.as_tensor(values, dtype=torch.float32, device=self.device) for values in postures
        )
        names = self.robot.joint_names
        self._fingers = {names.index(name): ends for name, ends in cfg.fingers.items()}

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        super()._resample_command(env_ids)
        draw = torch.rand(len(env_ids), device=self.device)
        in_hand = draw < self.cfg.in_hand
        posed = draw < self.cfg.in_hand + self.cfg.elsewhere
        if not posed.any():
            return
        rows = torch.randint(len(self._joint_pos), (len(env_ids),), device=self.device)
        opening = torch.rand(len(env_ids), device=self.device)
        joint_pos = self._joint_pos[rows]
        for column, (holding, around) in self._fingers.items():
            joint_pos[:, column] = holding + opening * (around - holding)
        joint_pos = joint_pos[posed]
        self.robot.write_joint_state_to_sim(
            joint_pos, torch.zeros_like(joint_pos), env_ids=env_ids[posed]
        )
        pose = self._hand_pose[rows[in_hand]]
        pose[:, :3] += self._env.scene.env_origins[env_ids[in_hand]]
        self.object.write_root_link_pose_to_sim(pose, env_ids=env_ids[in_hand])


def grasp_postures(
    model: mujoco.MjModel, robot: Entity, cfg: GraspStartsLiftingCommandCfg
) -> tuple[np.ndarray, np.ndarray]:
    """Return postures whose hand is within the ranges of `cfg` and points down.

    The same ones in every run. The robot's base is at the environment's origin.

    Returns joint positions, (K, J), and poses of the site (m, quaternion w x y z), (K, 7).

    Raises:
        ValueError: fewer than `num_postures` of 400,000 samples are.
    """
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    ids = robot.indexing.joint_ids.tolist()
    low, high = model.jnt_range[ids].T
    default = robot.data.default_joint_pos[0].double().cpu().numpy()
    drawn = np.array([name not in cfg.fingers for name in robot.joint_names])
    half = 0.5 * cfg.joint_range * (high - low) * drawn
    hand = data.site(f"{cfg.robot_name}/{cfg.site_name}")
    ranges = np.array([cfg.x, cfg.y, cfg.z])
    joint_pos, poses = [], []
    for _ in range(_MAX_DRAWS):
        q = np.clip(default + rng.uniform(-half, half), low, high)
        data.qpos[model.jnt_qposadr[ids]] = q
        mujoco.mj_kinematics(model, data)
        within = (ranges[:, 0] <= hand.xpos) & (hand.xpos <= ranges[:, 1])
        if not within.all() or -hand.xmat[8] < math.cos(cfg.max_tilt):
            continue
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, hand.xmat)
        joint_pos.append(q)
        poses.append(np.concatenate([hand.xpos, quat]))
        if len(poses) == cfg.num_postures:
            return np.array(joint_pos), np.array(poses)
    raise ValueError(
        f"GraspStartsLiftingCommandCfg: expected {cfg.num_postures} postures with the hand within x, y and "
        f"z, got {len(poses)} of {_MAX_DRAWS} samples; use wider ranges, or a larger joint_range or max_tilt."
    )
