"""Terms as releases 1.1 and 1.2 spelled them; reached through `mjlab.compat` only."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.tasks.velocity.mdp._shared import single_body, tilt_of

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")


def flat_orientation(
    env: ManagerBasedRlEnv, std: float, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Reward a body that stands upright: `upright` without terrain sensors."""
    asset: Entity = env.scene[asset_cfg.name]
    body = single_body(env, asset_cfg)
    data = asset.data
    quat = data.root_link_quat_w if body is None else data.body_link_quat_w[:, body]
    return torch.exp(tilt_of(quat) / -(std**2))
