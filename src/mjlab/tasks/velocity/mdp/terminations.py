"""Termination terms of the velocity task, (N,) bool."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.envs.mdp.terminations import illegal_contact
from mjlab.managers.scene_entity_config import SceneEntityCfg

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "illegal_contact",
    "out_of_terrain_bounds",
    "terrain_edge_reached",
]

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")
# Until the second step of an episode, positions are those before the reset.
_MIN_STEPS = 2


def out_of_terrain_bounds(
    env: ManagerBasedRlEnv, margin: float = 0.3, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Root outside the terrain, or within `margin` (m) of its edge.

    Never on a plane. The extent of a generated terrain is that of the grid as built, including the border.
    """
    asset: Entity = env.scene[asset_cfg.name]
    position = asset.data.root_link_pos_w
    terrain = env.scene.terrain
    if terrain is not None and terrain.bounds is not None:
        low, high = torch.tensor(terrain.bounds, device=position.device)
        x_y = position[:, :2]
        return ((x_y < low + margin) | (x_y > high - margin)).any(dim=1)
    if terrain is None or terrain.terrain_origins is None or terrain.cfg.terrain_generator is None:
        return torch.zeros_like(position[:, 0], dtype=torch.bool)
    rows, cols = terrain.terrain_origins.shape[:2]
    generator = terrain.cfg.terrain_generator
    border = max(generator.border_width, 0.0) - margin
    limit_x = max(rows * generator.size[0] / 2.0 + border, 0.0)
    limit_y = max(cols * generator.size[1] / 2.0 + border, 0.0)
    return (position[:, 0].abs() > limit_x) | (position[:, 1].abs() > limit_y)


def terrain_edge_reached(
    env: ManagerBasedRlEnv,
    threshold_fraction: float = 0.95,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Root at the edge of the environment's terrain cell.

    True if the distance to the environment origin, in x or y, exceeds `threshold_fraction` of half the
    cell size. Never on a plane, nor in the first two steps of an episode.
    """
    asset: Entity = env.scene[asset_cfg.name]
    offset = (asset.data.root_link_pos_w - env.scene.env_origins)[:, :2].abs()
    terrain = env.scene.terrain
    if terrain is None or terrain.terrain_origins is None or terrain.terrain_generator is None:
        return torch.zeros_like(offset[:, 0], dtype=torch.bool)
    size_x, size_y = terrain.terrain_generator.cfg.size
    reached_x = offset[:, 0] > size_x / 2.0 * threshold_fraction
    reached_y = offset[:, 1] > size_y / 2.0 * threshold_fraction
    return (reached_x | reached_y) & (env.episode_length_buf > _MIN_STEPS)


__getattr__ = older_names(__name__)
