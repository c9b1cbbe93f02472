"""Teacher of the reach tasks: joint targets that hold the hand at its goal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mjlab.entity import Entity
from mjlab.envs.mdp.actions import JointPositionAction, RelativeJointPositionAction
from mjlab.envs.mdp.pose_command import UniformPoseCommand, reachable_pose_command
from mjlab.managers import ObservationTermCfg
from mjlab.rl.exporter_utils import joint_gains

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

_LARGEST = 0.999
"""Bound of the actions shown for relative targets, which are bounded at every step."""


class goal_joint_action:
    """Action whose joint targets q* + t / k hold the hand at its goal, (N, A).

    With the joint positions q* at the goal, the torques t that hold them against gravity, and the stiffness
    k. At the YAM's shoulder and elbow, t / k is 0.12 rad in the mean over its goals; without, 2 of 16 goals are
    reached. Joints without a position servo have target q*. Relative targets go there as fast as they may.

    Params:
        command_name: Pose command with goals that can be reached.
        action_name: Action of the arm, of absolute or relative joint positions.

    Raises, when built, `TypeError` for a command or an action of another type, and `ValueError` for a command
    with `ranges`, whose joint positions are unknown.
    """

    # Derived from config and model; not checkpointed.
    _transient = {"_command", "_action", "_entity", "_compliance"}

    def __init__(self, cfg: ObservationTermCfg, env: ManagerBasedRlEnv) -> None:
        self._command, self._action = _terms(cfg, env)
        self._entity: Entity = env.scene[self._command.cfg.entity_name]
        stiffness = {n: kp for n, (kp, _) in joint_gains(self._entity, env.sim.mj_model).items()}
        names = [self._entity.joint_names[column] for column in self._command.joint_ids.tolist()]
        self._compliance = torch.tensor(
            [1.0 / stiffness[n] if stiffness.get(n, 0.0) > 0.0 else 0.0 for n in names],
            device=env.device,
        )

    def __call__(
        self, env: ManagerBasedRlEnv, command_name: str, action_name: str = "joint_pos"
    ) -> torch.Tensor:
        """Return the action, (N, A)."""
        command, action, data = self._command, self._action, self._entity.data
        targets = data.default_joint_pos.clone()
        targets[:, command.joint_ids] = (
            command.goal_joint_pos + command.goal_torque * self._compliance
        )
        targets = targets[:, action.target_ids]
        if isinstance(action, RelativeJointPositionAction):
            motion = (targets - data.joint_pos[:, action.target_ids]) / action.scale
            return motion.clamp(-_LARGEST, _LARGEST)
        return (targets - action.offset) / action.scale


class goal_hand_motion:
    """Motion of the hand at its goal per unit action, as rows of a matrix, (N, 6 A).

    Imitated actions then differ less where that moves the hand: J d, with the Jacobian J and the distance d of
    the joint targets, in units of `lengths`. Of a Panda's goals, 91 instead of 85 % are
    reached, without physics.

    Params:
        command_name: Pose command with goals that can be reached.
        lengths: Translation (m) and rotation (rad) that count as much as a unit action.
        action_name: Action of the arm, of absolute or relative joint positions.

    Raises as `goal_joint_action`.
    """

    # Derived from config and model; not checkpointed.
    _transient = {"_command", "_columns", "_scale"}

    def __init__(self, cfg: ObservationTermCfg, env: ManagerBasedRlEnv) -> None:
        self._command, action = _terms(cfg, env)
        entity: Entity = env.scene[self._command.cfg.entity_name]
        # Joints that do not move the hand have columns of zeros.
        columns = torch.zeros(
            len(entity.joint_names), len(self._command.joint_ids), device=env.device
        )
        columns[self._command.joint_ids, torch.arange(columns.shape[1])] = 1.0
        translation, rotation = cfg.params["lengths"]
        rows = torch.tensor([[translation]] * 3 + [[rotation]] * 3, device=env.device)
        self._columns = columns[action.target_ids].T
        scale = torch.as_tensor(action.scale, device=env.device)
        self._scale = scale.expand(env.num_envs, action.action_dim).unsqueeze(1) / rows

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        command_name: str,
        lengths: tuple[float, float],
        action_name: str = "joint_pos",
    ) -> torch.Tensor:
        """Return the matrix, row by row, (N, 6 A)."""
        return (self._command.goal_jacobian @ self._columns * self._scale).flatten(1)


def _terms(
    cfg: ObservationTermCfg, env: ManagerBasedRlEnv
) -> tuple[UniformPoseCommand, JointPositionAction | RelativeJointPositionAction]:
    """Return the command and the action of a term."""
    name = cfg.params.get("action_name", "joint_pos")
    action: Any = env.action_manager.get_term(name)
    if not isinstance(action, JointPositionAction | RelativeJointPositionAction):
        raise TypeError(
            f"action_name: expected a JointPositionAction or a RelativeJointPositionAction, got {name!r} of "
            f"type {type(action).__name__}."
        )
    return reachable_pose_command(env, cfg.params["command_name"]), action
