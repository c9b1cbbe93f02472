"""Teacher of the reach tasks: joint targets that hold the hand at its goal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.entity import Entity
from mjlab.envs.mdp.actions import JointPositionAction
from mjlab.envs.mdp.pose_command import reachable_pose_command
from mjlab.managers import ObservationTermCfg
from mjlab.rl.exporter_utils import joint_gains

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


class goal_joint_action:
    """Action whose joint targets q* + t / k hold the hand at its goal, (N, A).

    With the joint positions q* at the goal, the torques t that hold them against gravity, and the stiffness
    k. At the YAM's shoulder and elbow, t / k is 0.12 rad in the mean over its goals; without, 2 of 16 goals are
    reached. Joints without a position servo have target q*.

    Params:
        command_name: Pose command with goals that can be reached.
        action_name: Joint position action of the arm.

    Raises, when built, `TypeError` for a command or an action of another type, and `ValueError` for a command
    with `ranges`, whose joint positions are unknown.
    """

    # Derived from config and model; not checkpointed.
    _transient = {"_command", "_action", "_entity", "_compliance"}

    def __init__(self, cfg: ObservationTermCfg, env: ManagerBasedRlEnv) -> None:
        self._command = reachable_pose_command(env, cfg.params["command_name"])
        name = cfg.params.get("action_name", "joint_pos")
        action = env.action_manager.get_term(name)
        if not isinstance(action, JointPositionAction):
            raise TypeError(
                f"action_name: expected a JointPositionAction, got {name!r} of type "
                f"{type(action).__name__}."
            )
        self._action = action
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
        command, action = self._command, self._action
        targets = self._entity.data.default_joint_pos.clone()
        targets[:, command.joint_ids] = (
            command.goal_joint_pos + command.goal_torque * self._compliance
        )
        return (targets[:, action.target_ids] - action.offset) / action.scale
