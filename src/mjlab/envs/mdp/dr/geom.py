"""Randomization of geoms."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.envs.mdp.dr._core import (
    GEOM,
    MATERIAL,
    ROBOT,
    choose_ids,
    field_term,
    keep_absent,
    model_field,
    rotation_term,
    select,
)
from mjlab.managers.event_manager import requires_model_fields

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

geom_friction = field_term("geom_friction")
geom_pos = field_term("geom_pos")
geom_rgba = field_term("geom_rgba")
geom_size = field_term("geom_size")
geom_quat = rotation_term("geom_quat")


@requires_model_fields("geom_matid")
def geom_matid(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    asset_cfg: SceneEntityCfg = ROBOT,
    shared_random: bool = False,
) -> None:
    """Give each selected geom one of the selected materials, uniformly at random.

    Args:
        env_ids: Environments to change; None means all.
        asset_cfg: Entity, geoms (`geom_names`) and materials to choose from (`material_names`).
        shared_random: Choose one material per environment for all geoms.

    Raises:
        ValueError: no material is selected.
    """
    geoms = select(env, env_ids, asset_cfg, GEOM)
    materials = select(env, env_ids, asset_cfg, MATERIAL)
    field = model_field(env, "geom_matid")
    chosen = choose_ids(geoms, materials, shared_random)
    field[geoms.index] = keep_absent(geoms, chosen, field)
