"""Observation terms of the manipulation tasks, about hand, object and goal.

The end effector is the selected site of `asset_cfg`; the root is the entity's root link. Positions
of objects are those of their root links.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import older_names
from mjlab.envs.mdp._checks import require_command
from mjlab.envs.mdp._indexing import columns
from mjlab.managers.build_checks import checked_when_built
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.tasks.manipulation.mdp._shared import (
    check_entity,
    check_single,
    check_site,
    goal_command,
    lifting_command,
    site_pos,
    site_quat,
)
from mjlab.tasks.manipulation.mdp.camera_observations import camera_depth as camera_depth
from mjlab.tasks.manipulation.mdp.camera_observations import camera_rgb as camera_rgb
from mjlab.tasks.manipulation.mdp.camera_observations import (
    camera_segmentation as camera_segmentation,
)
from mjlab.tasks.manipulation.mdp.camera_observations import (
    camera_target_cube_mask as camera_target_cube_mask,
)
from mjlab.tasks.manipulation.mdp.reach import check_reach
from mjlab.utils.lab_api.math import quat_apply_inverse

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")


def _check_ee_to_object(
    env: ManagerBasedRlEnv,
    object_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    **_: Any,
) -> None:
    check_entity(env, object_name, "object_name")
    check_site(env, asset_cfg)


@checked_when_built(_check_ee_to_object)
def ee_to_object_distance(
    env: ManagerBasedRlEnv, object_name: str, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the end effector to the object in the frame of the root (m), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    target: Entity = env.scene[object_name]
    offset = target.data.root_link_pos_w - site_pos(env, asset_cfg)
    return quat_apply_inverse(asset.data.root_link_quat_w, offset)


def _check_object_to_goal(
    env: ManagerBasedRlEnv,
    object_name: str,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    **_: Any,
) -> None:
    check_single(env, command_name, object_name)
    check_entity(env, asset_cfg.name, "asset_cfg.name")


@checked_when_built(_check_object_to_goal)
def object_to_goal_distance(
    env: ManagerBasedRlEnv,
    object_name: str,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Vector from the object to its goal in the frame of the root (m), (N, 3).

    Raises:
        TypeError: the command is no `LiftingCommand`.
    """
    asset: Entity = env.scene[asset_cfg.name]
    target: Entity = env.scene[object_name]
    offset = lifting_command(env, command_name).target_pos - target.data.root_link_pos_w
    return quat_apply_inverse(asset.data.root_link_quat_w, offset)


def _check_target_position(
    env: ManagerBasedRlEnv,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    **_: Any,
) -> None:
    require_command(env, command_name)
    command = goal_command(env, command_name)
    check_reach(env, command_name, command.cfg, asset_cfg.name, check_site(env, asset_cfg))


@checked_when_built(_check_target_position)
def target_position(
    env: ManagerBasedRlEnv, command_name: str, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the end effector to the goal in the frame of the end effector (m), (N, 3).

    Raises:
        TypeError: the command is no `LiftingCommand` or `MultiCubeLiftingCommand`.
    """
    offset = goal_command(env, command_name).target_pos - site_pos(env, asset_cfg)
    return quat_apply_inverse(site_quat(env, asset_cfg), offset)


def _check_ee_velocity(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG, **_: Any
) -> None:
    check_site(env, asset_cfg)


@checked_when_built(_check_ee_velocity)
def ee_velocity(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Linear velocity of the end effector in its own frame (m/s), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    sites = columns(asset_cfg.site_ids, env.device)
    velocity = asset.data.site_lin_vel_w[:, sites].squeeze(1)
    return quat_apply_inverse(site_quat(env, asset_cfg), velocity)


__getattr__ = older_names(__name__)
