"""Reward terms of the manipulation tasks, (N,), unweighted.

The end effector is the selected site of `asset_cfg`. Positions of hand and object are both from
before the last physics substep.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.tasks.manipulation.mdp.commands import LiftingCommand, MultiCubeLiftingCommand
from mjlab.tasks.manipulation.mdp.observations import (
    DEFAULT_ASSET_CFG,
    goal_command,
    site_pos,
)

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "bring_object_reward",
    "joint_velocity_hinge_penalty",
    "multi_cube_bring_object_reward",
    "multi_cube_staged_position_reward",
    "staged_position_reward",
]


def staged_position_reward(
    env: ManagerBasedRlEnv,
    command_name: str,
    object_name: str,
    reaching_std: float,
    bringing_std: float,
    asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Reward reaching the object, then bringing it to its goal.

    `exp(-e^2 / reaching_std^2) (1 + exp(-g^2 / bringing_std^2))`, where e is the distance from
    the end effector to the object (m) and g the distance from the object to the goal (m).
    """
    target: Entity = env.scene[object_name]
    goal = goal_command(env, command_name, LiftingCommand).target_pos
    hand = site_pos(env, asset_cfg)
    return _staged(hand, target.data.root_link_pos_w, goal, reaching_std, bringing_std)


def bring_object_reward(
    env: ManagerBasedRlEnv, command_name: str, object_name: str, std: float
) -> torch.Tensor:
    """Reward an object at its goal: `exp(-g^2 / std^2)`, g: distance from object to goal (m)."""
    target: Entity = env.scene[object_name]
    goal = goal_command(env, command_name, LiftingCommand).target_pos
    return _closeness(target.data.root_link_pos_w, goal, std)


def multi_cube_staged_position_reward(
    env: ManagerBasedRlEnv,
    command_name: str,
    reaching_std: float,
    bringing_std: float,
    asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Reward reaching the target object and its goal; see `staged_position_reward`."""
    command = goal_command(env, command_name, MultiCubeLiftingCommand)
    hand = site_pos(env, asset_cfg)
    target = command.target_object_pos()
    return _staged(hand, target, command.target_pos, reaching_std, bringing_std)


def multi_cube_bring_object_reward(
    env: ManagerBasedRlEnv, command_name: str, std: float
) -> torch.Tensor:
    """Reward the target object at its goal; see `bring_object_reward`."""
    command = goal_command(env, command_name, MultiCubeLiftingCommand)
    return _closeness(command.target_object_pos(), command.target_pos, std)


def joint_velocity_hinge_penalty(
    env: ManagerBasedRlEnv, max_vel: float, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Penalize joints faster than `max_vel`: the sum of `max(|v| - max_vel, 0)^2`.

    Velocities are in rad/s, in m/s for slide joints. The value is positive; use a negative weight.
    """
    asset: Entity = env.scene[asset_cfg.name]
    speed = asset.data.joint_vel[:, columns_of(asset_cfg, "joint", env)].abs()
    return speed.sub_(max_vel).clamp_(min=0.0).square_().sum(dim=1)


def _staged(
    hand: torch.Tensor,
    target: torch.Tensor,
    goal: torch.Tensor,
    reaching_std: float,
    bringing_std: float,
) -> torch.Tensor:
    reaching = _closeness(hand, target, reaching_std)
    return reaching * (1.0 + _closeness(target, goal, bringing_std))


def _closeness(one: torch.Tensor, other: torch.Tensor, std: float) -> torch.Tensor:
    return torch.exp((one - other).square().sum(dim=1) / -(std**2))


__getattr__ = older_names(__name__)
