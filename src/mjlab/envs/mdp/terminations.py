"""Termination terms, (N,) bool."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.utils.nan_guard import NanGuard

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "bad_orientation",
    "illegal_contact",
    "joint_pos_out_of_limit",
    "nan_detection",
    "root_height_below_minimum",
    "time_out",
]

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")


def time_out(env: ManagerBasedRlEnv) -> torch.Tensor:
    """True where the episode has reached its maximum length."""
    return env.episode_length_buf >= env.max_episode_length


def bad_orientation(
    env: ManagerBasedRlEnv,
    limit_angle: float,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """True where the root is tilted from upright by more than `limit_angle` (rad)."""
    asset: Entity = env.scene[asset_cfg.name]
    up = (-asset.data.projected_gravity_b[:, 2]).clamp_(-1.0, 1.0)
    return torch.acos(up) > limit_angle


def root_height_below_minimum(
    env: ManagerBasedRlEnv,
    minimum_height: float,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """True where the root is below `minimum_height` (m) in world coordinates."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.root_link_pos_w[:, 2] < minimum_height


def joint_pos_out_of_limit(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """True where a selected joint is beyond its soft position limits."""
    asset: Entity = env.scene[asset_cfg.name]
    joints = columns_of(asset_cfg, "joint", env)
    position = asset.data.joint_pos[:, joints]
    low, high = asset.data.soft_joint_pos_limits[:, joints].unbind(-1)
    return ((position < low) | (position > high)).any(dim=1)


def illegal_contact(
    env: ManagerBasedRlEnv, sensor_name: str, force_threshold: float = 10.0
) -> torch.Tensor:
    """True where a contact sensor reports an illegal contact.

    With a force history: any force above `force_threshold` (N) in any substep of the history.
    Without one: any contact.
    """
    data = env.scene[sensor_name].data
    if data.force_history is None:
        return (data.found > 0).any(dim=1)
    hits = data.force_history.square().sum(dim=-1) > force_threshold**2
    return hits.flatten(start_dim=1).any(dim=1)


def nan_detection(env: ManagerBasedRlEnv) -> torch.Tensor:
    """True where positions, velocities, accelerations or sensor data are NaN or infinite."""
    return NanGuard.detect_nans(env.sim.data)
