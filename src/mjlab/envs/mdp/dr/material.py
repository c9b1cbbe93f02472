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
from mjlab.utils.errors import check_in_range

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

__all__ = [
    "mat_emission",
    "mat_rgba",
    "mat_shininess",
    "mat_specular",
    "mat_texid",
    "mat_texrepeat",
]

mat_emission = field_term(__name__, "mat_emission", MATERIAL, "Randomize material emission.")
mat_rgba = field_term(
    __name__,
    "mat_rgba",
    MATERIAL,
    "Randomize material colors r, g, b, a in [0, 1]. Textures are multiplied by the color.",
)
mat_shininess = field_term(__name__, "mat_shininess", MATERIAL, "Randomize shininess in [0, 1].")
mat_specular = field_term(__name__, "mat_specular", MATERIAL, "Randomize specularity in [0, 1].")
mat_texrepeat = field_term(__name__, "mat_texrepeat", MATERIAL, "Randomize texture repeats x, y.")


@requires_model_fields("mat_texid")
def mat_texid(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    asset_cfg: SceneEntityCfg = ROBOT,
    role: int = 1,
    shared_random: bool = False,
) -> None:
    """Assign each selected material one of the selected textures, uniformly at random.

    Args:
        env_ids: Environments to change. None: all.
        asset_cfg: Entity, materials (`material_names`) and textures to choose from
            (`texture_names`).
        role: Texture slot to write, an `mjtTextureRole`; 1 is RGB.
        shared_random: Choose one texture per environment for all materials.

    Raises:
        ValueError: no texture is selected, or invalid role.
    """
    materials = select(env, env_ids, asset_cfg, MATERIAL)
    textures = select(env, env_ids, asset_cfg, TEXTURE)
    field = model_field(env, "mat_texid")
    check_in_range("mat_texid role", role, 0, field.shape[-1] - 1)
    field[(*materials.index, role)] = choose_ids(materials, textures, shared_random)
