"""Observation terms of the manipulation tasks: hand, object, goal and images.

The end effector is the selected site of `asset_cfg`; the root is the entity's root link. Object
positions are positions of their root links. Images have channels first: (N, C, height, width).
"""

from __future__ import annotations

import math
import warnings
from functools import partial
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.managers.term_checks import checked_when_built, require_sensor
from mjlab.sensor import CameraSensor
from mjlab.tasks.manipulation.mdp.commands import (
    LiftingCommand,
    MultiCubeLiftingCommand,
    check_reach,
)
from mjlab.utils.errors import WrongTypeError, check_exists, check_in_range, check_positive, warned
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
"""Default entity of the end-effector site."""
_GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)


def check_task_term(
    env: ManagerBasedRlEnv,
    *,
    kinds: tuple[type, ...] = (),
    has_hand: bool = False,
    command_name: str | None = None,
    object_name: str | None = None,
    asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG,
    max_vel: float = 0.0,
    **params: Any,
) -> None:
    """Check a term of a manipulation task.

    Args:
        env: The environment.
        kinds: Classes of commands that the term reads; see `goal_command`.
        has_hand: The term reads the end effector, a site of `asset_cfg`.
        command_name: Parameter of the term, as the following ones.
        object_name: Entity.
        asset_cfg: Robot.
        max_vel: Speed limit, >= 0.
        params: Further parameters; `std` and `..._std` must be positive.

    Raises:
        KeyError: unknown command.
        TypeError: the command is not of `kinds`.
        ValueError: unknown object, or not exactly one site.

    Warns of numbers outside their ranges, and of goals out of reach.
    """
    for name, value in params.items():
        if name.endswith("std"):
            with warned():
                check_positive(name, value)
    with warned():
        check_in_range("max_vel", max_vel, 0.0, math.inf)
    if object_name is not None:
        check_exists("entity in object_name", object_name, env.scene.entities)
    command = None if command_name is None else goal_command(env, command_name, *kinds)
    if has_hand:
        site = find_site(env, asset_cfg)
        # One warning for all terms that read the same goal and hand.
        place, known = (command_name, asset_cfg.name, site), vars(env).setdefault("_reached", set())
        if command is not None and place not in known:
            known.add(place)
            check_reach(env, str(command_name), command.cfg, asset_cfg.name, site)


def find_site(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> str:
    """Return the name of the selected site; raises `ValueError` unless exactly one is selected."""
    names, ids = env.scene[asset_cfg.name].site_names, columns_of(asset_cfg, "site", env)
    selected = list(names[ids]) if isinstance(ids, slice) else [names[index] for index in ids]
    if len(selected) != 1:
        raise ValueError(
            f"asset_cfg: expected one site of entity {asset_cfg.name!r}, got {len(selected)}; set "
            f"site_names, e.g. to the site between the fingers. Available: {list(names)}."
        )
    return selected[0]


@checked_when_built(partial(check_task_term, has_hand=True))
def ee_to_object_distance(
    env: ManagerBasedRlEnv, object_name: str, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the end effector to the object in the frame of the root (m), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    target: Entity = env.scene[object_name]
    offset = target.data.root_link_pos_w - site_pos(env, asset_cfg)
    return quat_apply_inverse(asset.data.root_link_quat_w, offset)


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
    asset: Entity = env.scene[asset_cfg.name]
    target: Entity = env.scene[object_name]
    goal = goal_command(env, command_name, LiftingCommand).target_pos
    offset = goal - target.data.root_link_pos_w
    return quat_apply_inverse(asset.data.root_link_quat_w, offset)


@checked_when_built(partial(check_task_term, has_hand=True))
def target_position(
    env: ManagerBasedRlEnv, command_name: str, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Vector from the end effector to the goal in the frame of the end effector (m), (N, 3).

    Raises:
        TypeError: the command is not a `LiftingCommand` or `MultiCubeLiftingCommand`.
    """
    offset = goal_command(env, command_name).target_pos - site_pos(env, asset_cfg)
    return quat_apply_inverse(site_quat(env, asset_cfg), offset)


@checked_when_built(partial(check_task_term, has_hand=True))
def ee_velocity(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Linear velocity of the end effector in the end-effector frame (m/s), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    sites = columns_of(asset_cfg, "site", env)
    velocity = asset.data.site_lin_vel_w[:, sites].squeeze(1)
    return quat_apply_inverse(site_quat(env, asset_cfg), velocity)


# Images.


def _check_camera(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    data_type: str,
    min_depth: float = 0.01,
    cutoff_distance: float = math.inf,
    **_: Any,
) -> None:
    cfg = require_sensor(env, sensor_name, CameraSensor).cfg
    if data_type not in cfg.data_types:
        raise ValueError(
            f"Camera {sensor_name!r} data_types: expected {data_type!r} among them, got "
            f"{tuple(cfg.data_types)}; add it."
        )
    if not 0.0 <= min_depth < cutoff_distance:
        warnings.warn(
            "min_depth and cutoff_distance: expected 0 <= min_depth < cutoff_distance, got "
            f"{min_depth} and {cutoff_distance}.",
            UserWarning,
            stacklevel=2,
        )


@checked_when_built(partial(_check_camera, data_type="rgb"))
def camera_rgb(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """RGB image in [0, 1], (N, 3, height, width)."""
    return env.scene[sensor_name].data.rgb.permute(0, 3, 1, 2).float().div_(255.0)


@checked_when_built(partial(_check_camera, data_type="depth"))
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


@checked_when_built(partial(_check_camera, data_type="segmentation"))
def camera_segmentation(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Object id and type of each pixel, (N, 2, height, width) int32; background: (-1, -1)."""
    return env.scene[sensor_name].data.segmentation.permute(0, 3, 1, 2)


@checked_when_built(partial(_check_camera, data_type="segmentation"))
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
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.site_pos_w[:, columns_of(asset_cfg, "site", env)].squeeze(1)


def site_quat(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the world orientation of the selected site, (N, 4)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.site_quat_w[:, columns_of(asset_cfg, "site", env)].squeeze(1)


__getattr__ = older_names(__name__)
