"""Randomization of materials."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.envs.mdp.dr._core import (
    MATERIAL,
    ROBOT,
    TEXTURE,
    choose_ids,
    field_term,
    model_field,
    select,
)
from mjlab.managers.event_manager import requires_model_fields

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

mat_emission = field_term("mat_emission")
mat_rgba = field_term("mat_rgba")
mat_shininess = field_term("mat_shininess")
mat_specular = field_term("mat_specular")
mat_texrepeat = field_term("mat_texrepeat")


@requires_model_fields("mat_texid")
def mat_texid(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    asset_cfg: SceneEntityCfg = ROBOT,
    role: int = 1,
    shared_random: bool = False,
) -> None:
    """Give each selected material one of the selected textures, uniformly at random.

    Args:
        env_ids: Environments to change; None means all.
        asset_cfg: Entity, materials (`material_names`) and textures to choose from
            (`texture_names`).
        role: Texture slot to write, an `mjtTextureRole`; 1 is RGB.
        shared_random: Choose one texture per environment for all materials.

    Raises:
        ValueError: no texture is selected, or there is no such role.
    """
    materials = select(env, env_ids, asset_cfg, MATERIAL)
    textures = select(env, env_ids, asset_cfg, TEXTURE)
    field = model_field(env, "mat_texid")
    if not 0 <= role < field.shape[-1]:
        raise ValueError(
            f"mat_texid: role {role} does not exist; it is 0 to {field.shape[-1] - 1}."
        )
    field[(*materials.index, role)] = choose_ids(materials, textures, shared_random)
