"""Observation terms of the manipulation tasks, about hand, object and goal.

The end effector is the selected site of `asset_cfg`; the root is the entity's root link. Positions
of objects are those of their root links. Images have channels first, as networks take them:
(N, C, height, width).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.managers.term_checks import checked_when_built, require_command, require_sensor
from mjlab.sensor import CameraSensor
from mjlab.tasks.manipulation.mdp.commands import (
    LiftingCommand,
    MultiCubeLiftingCommand,
    check_reach,
)
from mjlab.utils.errors import WrongTypeError, check_exists, check_positive
from mjlab.utils.indexing import as_columns
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
    "ee_velocity",
    "object_to_goal_distance",
    "target_position",
]

DEFAULT_ASSET_CFG = SceneEntityCfg("robot")
"""The entity whose site terms take for the hand unless they are told."""
_GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)


def _check_ee_to_object(
    env: ManagerBasedRlEnv,
    object_name: str,
    asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG,
    **_: Any,
) -> None:
    check_entity(env, object_name, "object_name")
    check_site(env, asset_cfg)


@checked_when_built(_check_ee_to_object)
def ee_to_object_distance(
    env: ManagerBasedRlEnv, object_name: str, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
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
    asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG,
    **_: Any,
) -> None:
    check_single(env, command_name, object_name)
    check_entity(env, asset_cfg.name, "asset_cfg.name")


@checked_when_built(_check_object_to_goal)
def object_to_goal_distance(
    env: ManagerBasedRlEnv,
    object_name: str,
    command_name: str,
    asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG,
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
    asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG,
    **_: Any,
) -> None:
    require_command(env, command_name)
    command = goal_command(env, command_name)
    check_reach(env, command_name, command.cfg, asset_cfg.name, check_site(env, asset_cfg))


@checked_when_built(_check_target_position)
def target_position(
    env: ManagerBasedRlEnv, command_name: str, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the end effector to the goal in the frame of the end effector (m), (N, 3).

    Raises:
        TypeError: the command is no `LiftingCommand` or `MultiCubeLiftingCommand`.
    """
    offset = goal_command(env, command_name).target_pos - site_pos(env, asset_cfg)
    return quat_apply_inverse(site_quat(env, asset_cfg), offset)


def _check_ee_velocity(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG, **_: Any
) -> None:
    check_site(env, asset_cfg)


@checked_when_built(_check_ee_velocity)
def ee_velocity(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Linear velocity of the end effector in its own frame (m/s), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    sites = as_columns(asset_cfg.site_ids, env.device)
    velocity = asset.data.site_lin_vel_w[:, sites].squeeze(1)
    return quat_apply_inverse(site_quat(env, asset_cfg), velocity)


# Images.


def _check_camera(env: ManagerBasedRlEnv, sensor_name: str, data_type: str, **_: Any) -> None:
    cfg = require_sensor(env, sensor_name, CameraSensor).cfg
    if data_type not in cfg.data_types:
        raise ValueError(
            f"The camera {sensor_name!r} has data_types={tuple(cfg.data_types)}; add {data_type!r}."
        )


@checked_when_built(partial(_check_camera, data_type="rgb"))
def camera_rgb(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Red, green and blue in [0, 1], (N, 3, height, width)."""
    return env.scene[sensor_name].data.rgb.permute(0, 3, 1, 2).float().div_(255.0)


def _check_depth(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    cutoff_distance: float,
    min_depth: float = 0.01,
    **_: Any,
) -> None:
    _check_camera(env, sensor_name, "depth")
    if not 0.0 <= min_depth < cutoff_distance:
        raise ValueError(
            f"min_depth is {min_depth} and cutoff_distance is {cutoff_distance}; the first must not "
            "be negative, and has to be smaller than the second."
        )


@checked_when_built(_check_depth)
def camera_depth(
    env: ManagerBasedRlEnv, sensor_name: str, cutoff_distance: float, min_depth: float = 0.01
) -> torch.Tensor:
    """Depth as a share of `cutoff_distance`, in [0, 1], (N, 1, height, width).

    Depth is the distance along the optical axis. What is closer than `min_depth` (m) counts as if
    it were there, and what is further than `cutoff_distance` (m) as if it were at that. So does the
    background, for which the camera reports a depth of 0.
    """
    depth = env.scene[sensor_name].data.depth.permute(0, 3, 1, 2)
    share = depth.clamp(min_depth, cutoff_distance).div_(cutoff_distance)
    # Written so that NaN, too, is background.
    return torch.where(depth > 0.0, share, 1.0)


@checked_when_built(partial(_check_camera, data_type="segmentation"))
def camera_segmentation(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Id and type of the object at each pixel, (N, 2, height, width) int32; -1, -1: background."""
    return env.scene[sensor_name].data.segmentation.permute(0, 3, 1, 2)


def _check_mask(env: ManagerBasedRlEnv, sensor_name: str, command_name: str, **_: Any) -> None:
    _check_camera(env, sensor_name, "segmentation")
    require_command(env, command_name)
    multi_cube_command(env, command_name)


@checked_when_built(_check_mask)
def camera_target_cube_mask(
    env: ManagerBasedRlEnv, sensor_name: str, command_name: str
) -> torch.Tensor:
    """1 where the wanted object is seen, else 0, (N, 1, height, width).

    Raises:
        TypeError: the command is no `MultiCubeLiftingCommand`.
    """
    wanted = multi_cube_command(env, command_name).target_geom_ids
    ids, types = env.scene[sensor_name].data.segmentation.unbind(dim=-1)
    is_wanted = (ids.unsqueeze(-1) == wanted[:, None, None, :]).any(dim=-1)
    return (is_wanted & (types == _GEOM)).float().unsqueeze(1)


# Look-ups and checks that several terms share.


def lifting_command(env: ManagerBasedRlEnv, name: str) -> LiftingCommand:
    """Return the command for one object; raises `TypeError` if it is of another kind."""
    return _command(env, name, LiftingCommand)


def multi_cube_command(env: ManagerBasedRlEnv, name: str) -> MultiCubeLiftingCommand:
    """Return the command for one object of several; raises `TypeError` if it is of another kind."""
    return _command(env, name, MultiCubeLiftingCommand)


def goal_command(env: ManagerBasedRlEnv, name: str) -> LiftingCommand | MultiCubeLiftingCommand:
    """Return a command with a goal; raises `TypeError` if it has none."""
    return _command(env, name, (LiftingCommand, MultiCubeLiftingCommand))


def _command(env: ManagerBasedRlEnv, name: str, kind: Any) -> Any:
    command = env.command_manager.get_term(name)
    if not isinstance(command, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        wanted = " or a ".join(cls.__name__ for cls in kinds)
        raise WrongTypeError(
            f"The command {name!r} is a {type(command).__name__}; a {wanted} is needed."
        )
    return command


def site_pos(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the position of the one selected site in the world, (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.site_pos_w[:, as_columns(asset_cfg.site_ids, env.device)].squeeze(1)


def site_quat(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the orientation of the one selected site in the world, (N, 4)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.site_quat_w[:, as_columns(asset_cfg.site_ids, env.device)].squeeze(1)


def check_single(
    env: ManagerBasedRlEnv,
    command_name: str,
    object_name: str,
    asset_cfg: SceneEntityCfg | None = None,
    **params: Any,
) -> None:
    """Check a term about one object and its goal, and whether the arm of `asset_cfg` reaches it."""
    require_command(env, command_name)
    command = lifting_command(env, command_name)
    check_entity(env, object_name, "object_name")
    check_stds(**params)
    if asset_cfg is not None:
        check_reach(env, command_name, command.cfg, asset_cfg.name, check_site(env, asset_cfg))


def check_single_with_hand(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG, **params: Any
) -> None:
    """Check a term about a hand, one object and its goal."""
    check_single(env, asset_cfg=asset_cfg, **params)


def check_multi(
    env: ManagerBasedRlEnv,
    command_name: str,
    asset_cfg: SceneEntityCfg | None = None,
    **params: Any,
) -> None:
    """Check a term about one object of several, likewise."""
    require_command(env, command_name)
    command = multi_cube_command(env, command_name)
    check_stds(**params)
    if asset_cfg is not None:
        check_reach(env, command_name, command.cfg, asset_cfg.name, check_site(env, asset_cfg))


def check_multi_with_hand(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG, **params: Any
) -> None:
    """Check a term about a hand, one object of several and its goal."""
    check_multi(env, asset_cfg=asset_cfg, **params)


def check_entity(env: ManagerBasedRlEnv, name: str, label: str) -> None:
    """Raise `ValueError` unless the scene has an entity of that name."""
    check_exists(f"entity in {label}", name, env.scene.entities)


def check_site(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> str:
    """Return the name of the one selected site; raises `ValueError` if it is not one."""
    check_entity(env, asset_cfg.name, "asset_cfg.name")
    names = env.scene.entities[asset_cfg.name].site_names
    ids = asset_cfg.site_ids
    selected = list(names[ids]) if isinstance(ids, slice) else [names[index] for index in ids]
    if len(selected) != 1:
        raise ValueError(
            f"asset_cfg selects {len(selected)} sites of entity {asset_cfg.name!r}; the term needs "
            "one, such as the site between the fingers. Give it as site_names; there are "
            f"{list(names)}."
        )
    return selected[0]


def check_stds(**params: Any) -> None:
    """Raise `ValueError` unless all parameters called `std` or `..._std` are positive."""
    for name, value in params.items():
        if name.endswith("std"):
            check_positive(name, value)


__getattr__ = older_names(__name__)
