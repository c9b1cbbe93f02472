"""Observation terms of the manipulation tasks: hand, object, goal and images.

The end effector is the selected site of `asset_cfg`; the root is the entity's root link. Object
positions are positions of their root links. Images have channels first: (N, C, height, width).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.tasks.manipulation.mdp.commands import (
    LiftingCommand,
    MultiCubeLiftingCommand,
)
from mjlab.utils.errors import WrongTypeError
from mjlab.utils.lab_api.math import quat_apply_inverse

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "camera_depth",
    "camera_rgb",
    "camera_segmentation",
    "camera_target_cube_mask",
    "ee_to_object_distance",
    "ee_to_target_object",
    "ee_velocity",
    "object_to_goal_distance",
    "target_object_to_goal",
    "target_position",
]

DEFAULT_ASSET_CFG = SceneEntityCfg("robot")
"""Default entity of the end-effector site."""
_GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)


def ee_to_object_distance(
    env: ManagerBasedRlEnv, object_name: str, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the end effector to the object in the frame of the root (m), (N, 3)."""
    target: Entity = env.scene[object_name]
    offset = target.data.root_link_pos_w - site_pos(env, asset_cfg)
    return _in_root_frame(env, asset_cfg, offset)


def object_to_goal_distance(
    env: ManagerBasedRlEnv,
    object_name: str,
    command_name: str,
    asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Vector from the object to its goal in the frame of the root (m), (N, 3).

    Raises:
        TypeError: the command is not a `LiftingCommand`.
    """
    target: Entity = env.scene[object_name]
    goal = goal_command(env, command_name, LiftingCommand).target_pos
    return _in_root_frame(env, asset_cfg, goal - target.data.root_link_pos_w)


def ee_to_target_object(
    env: ManagerBasedRlEnv, command_name: str, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the end effector to the object of a command in the frame of the root (m), (N, 3).

    Raises:
        TypeError: the command is not a `LiftingCommand` or `MultiCubeLiftingCommand`.
    """
    target = goal_command(env, command_name).object_pos()
    return _in_root_frame(env, asset_cfg, target - site_pos(env, asset_cfg))


def target_object_to_goal(
    env: ManagerBasedRlEnv, command_name: str, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the object of a command to its goal in the frame of the root (m), (N, 3).

    Raises:
        TypeError: the command is not a `LiftingCommand` or `MultiCubeLiftingCommand`.
    """
    command = goal_command(env, command_name)
    return _in_root_frame(env, asset_cfg, command.target_pos - command.object_pos())


def target_position(
    env: ManagerBasedRlEnv, command_name: str, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the end effector to the goal in the frame of the end effector (m), (N, 3).

    Raises:
        TypeError: the command is not a `LiftingCommand` or `MultiCubeLiftingCommand`.
    """
    offset = goal_command(env, command_name).target_pos - site_pos(env, asset_cfg)
    return quat_apply_inverse(site_quat(env, asset_cfg), offset)


def ee_velocity(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Linear velocity of the end effector in the end-effector frame (m/s), (N, 3)."""
    velocity = _at_site(env, asset_cfg, env.scene[asset_cfg.name].data.site_lin_vel_w)
    return quat_apply_inverse(site_quat(env, asset_cfg), velocity)


def _in_root_frame(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg, vector: torch.Tensor
) -> torch.Tensor:
    """Return a world-frame `vector` (N, 3) in the frame of the root of an entity."""
    asset: Entity = env.scene[asset_cfg.name]
    return quat_apply_inverse(asset.data.root_link_quat_w, vector)


# Images.


def camera_rgb(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """RGB image in [0, 1], (N, 3, height, width)."""
    return env.scene[sensor_name].data.rgb.permute(0, 3, 1, 2).float().div_(255.0)


def camera_depth(
    env: ManagerBasedRlEnv, sensor_name: str, cutoff_distance: float, min_depth: float = 0.01
) -> torch.Tensor:
    """Depth as a fraction of `cutoff_distance`, in [0, 1], (N, 1, height, width).

    Depth is the distance along the optical axis, clamped to [`min_depth`, `cutoff_distance`] (m).
    Background pixels, reported by the camera as depth 0, are 1.
    """
    depth = env.scene[sensor_name].data.depth.permute(0, 3, 1, 2)
    fraction = depth.clamp(min_depth, cutoff_distance).div_(cutoff_distance)
    # depth > 0 is False for NaN, which thus counts as background.
    return torch.where(depth > 0.0, fraction, 1.0)


def camera_segmentation(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Object id and type of each pixel, (N, 2, height, width) int32; background: (-1, -1)."""
    return env.scene[sensor_name].data.segmentation.permute(0, 3, 1, 2)


def camera_target_cube_mask(
    env: ManagerBasedRlEnv, sensor_name: str, command_name: str
) -> torch.Tensor:
    """Mask of the target object: 1 at its pixels, else 0, (N, 1, height, width).

    Raises:
        TypeError: the command is not a `MultiCubeLiftingCommand`.
    """
    target = goal_command(env, command_name, MultiCubeLiftingCommand).target_geom_ids
    ids, types = env.scene[sensor_name].data.segmentation.unbind(dim=-1)
    is_target = (ids.unsqueeze(-1) == target[:, None, None, :]).any(dim=-1)
    return (is_target & (types == _GEOM)).float().unsqueeze(1)


# Shared lookups.


def goal_command(env: ManagerBasedRlEnv, name: str, *kinds: type) -> Any:
    """Return the command; raises `TypeError` unless it is of one of `kinds` (default: either lifting command)."""
    kinds = kinds or (LiftingCommand, MultiCubeLiftingCommand)
    command = env.command_manager.get_term(name)
    if not isinstance(command, kinds):
        expected = " or ".join(kind.__name__ for kind in kinds)
        raise WrongTypeError(
            f"Command {name!r}: expected {expected}, got {type(command).__name__}."
        )
    return command


def site_pos(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the world position of the selected site, (N, 3)."""
    return _at_site(env, asset_cfg, env.scene[asset_cfg.name].data.site_pos_w)


def site_quat(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the world orientation of the selected site, (N, 4)."""
    return _at_site(env, asset_cfg, env.scene[asset_cfg.name].data.site_quat_w)


def _at_site(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg, values: torch.Tensor
) -> torch.Tensor:
    """Return the row of `values`, (N, sites, D), of the selected site; raises unless it is one."""
    chosen = values[:, columns_of(asset_cfg, "site", env)]
    if chosen.shape[1] != 1:
        raise ValueError(
            f"asset_cfg: expected one site of entity {asset_cfg.name!r}, got {chosen.shape[1]}; set "
            f"site_names. Available: {list(env.scene[asset_cfg.name].site_names)}."
        )
    return chosen[:, 0]


__getattr__ = older_names(__name__)
