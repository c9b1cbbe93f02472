"""Randomization of materials."""

from __future__ import annotations

from typing import Any

import mujoco
import pytest

from mjlab.envs.mdp import dr
from mjlab.managers.scene_entity_config import SceneEntityCfg


def test_mat_texid_writes_one_role(make_world: Any) -> None:
    world = make_world(num_envs=16)
    chosen = SceneEntityCfg("robot", material_names=("mat_b",), texture_names=("tex_.*",))
    world.apply(dr.mat_texid, asset_cfg=chosen)
    ids = world.sim.model.mat_texid
    rgb = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    assert sorted(ids[:, 1, rgb].unique().tolist()) == [0, 1]
    others = [role for role in range(ids.shape[-1]) if role != rgb]
    assert bool((ids[:, 1, others] == -1).all())
    with pytest.raises(ValueError, match="role.*99"):
        world.apply(dr.mat_texid, asset_cfg=chosen, role=99)
