"""The ground, and where the environments are on it."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mjlab.terrains import TerrainEntity, TerrainEntityCfg
from mjlab.terrains.origins import assign_columns, grid_origins, split_by_proportion


def terrain(**fields) -> TerrainEntity:
    return TerrainEntity(TerrainEntityCfg(**fields), "cpu")


# The plane.


def test_the_plane_is_one_static_geom_with_mujocos_contact_defaults():
    entity = terrain()
    model = entity.compile()
    geom = model.geom("terrain")
    assert (model.nbody, model.ngeom, model.nmocap) == (2, 1, 0)
    assert geom.type[0] == mujoco.mjtGeom.mjGEOM_PLANE
    assert geom.size.tolist() == [0.0, 0.0, 0.01]
    assert geom.friction.tolist() == [1.0, 0.005, 0.0001]
    assert (geom.condim[0], geom.group[0]) == (3, 0)
    assert entity.body_names == ("terrain",)
    assert not entity.is_mocap


def test_the_plane_is_lit_and_checkered():
    model = terrain().compile()
    sun = model.light("sun")
    assert sun.type[0] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    assert sun.pos.tolist() == [0.0, 0.0, 1.5]
    assert sun.dir.tolist() == [0.0, 0.0, -1.0]
    assert model.mat(model.geom("terrain").matid[0]).name == "groundplane"
    assert model.tex("groundplane").name == "groundplane"


def test_levels_and_types_are_none_on_a_plane():
    """The reference does not have the attributes at all."""
    plane = terrain(num_envs=3)
    assert plane.terrain_origins is plane.terrain_levels is plane.terrain_types is None
    assert plane.flat_patches == {}
    assert plane.flat_patch_radii == {}
    before = plane.env_origins.clone()
    ids = torch.tensor([0, 1])
    plane.update_env_origins(ids, torch.ones(2).bool(), torch.zeros(2).bool())
    plane.randomize_env_origins(ids)
    assert torch.equal(plane.env_origins, before)


def test_debug_sites_show_the_origins():
    entity = terrain(num_envs=3, env_spacing=4.0, debug_vis=True)
    model = entity.compile()
    for index in range(3):
        site = model.site(f"env_origin_{index}")
        assert site.pos.tolist() == entity.env_origins[index].tolist()
        assert (site.size[0], site.group[0]) == (0.3, 4)
    assert terrain(num_envs=3).compile().nsite == 0


def test_configs_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="'hills'; it must be 'plane' or 'generator'"):
        terrain(terrain_type="hills")
    with pytest.raises(ValueError, match="env_spacing is None"):
        terrain(env_spacing=None)
    with pytest.raises(ValueError, match="'generator' is not available"):
        terrain(terrain_type="generator")
    with pytest.raises(TypeError, match=r"TerrainEntity\(cfg, device\)"):
        TerrainEntityCfg().build()


# Flat ground.


@given(st.integers(1, 300), st.floats(0.1, 10.0))
def test_the_grid_is_the_formula_of_the_reference(num_envs, spacing):
    rows = math.ceil(num_envs / math.floor(math.sqrt(num_envs)))
    cols = math.ceil(num_envs / rows)
    expected = [
        [-(k // cols - (rows - 1) / 2) * spacing, (k % cols - (cols - 1) / 2) * spacing, 0.0]
        for k in range(num_envs)
    ]
    torch.testing.assert_close(grid_origins(num_envs, spacing, "cpu"), torch.tensor(expected))


def test_a_grid_of_four_by_hand():
    assert grid_origins(4, 2.0, "cpu").tolist() == [
        [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0],
    ]  # fmt: skip


@given(st.integers(2, 200))
def test_no_two_environments_share_an_origin(num_envs):
    origins = grid_origins(num_envs, 1.0, "cpu")
    assert len(torch.unique(origins, dim=0)) == num_envs


# Generated ground.


def grid(rows: int, cols: int) -> torch.Tensor:
    """Spawn points that say which cell they belong to."""
    row, col = torch.meshgrid(torch.arange(rows), torch.arange(cols), indexing="ij")
    return torch.stack((row, col, 100 * row + col), dim=-1).float()


def test_the_split_of_the_documented_example():
    shares = np.array([0.2, 0.2, 0.2, 0.1, 0.1, 0.1, 0.1])
    assert split_by_proportion(4096, shares) == [818, 819, 819, 410, 410, 410, 410]
    assert split_by_proportion(10, shares) == [2, 2, 2, 1, 1, 1, 1]


@given(
    st.integers(1, 500),
    st.lists(st.floats(0.0, 5.0), min_size=1, max_size=8).filter(lambda x: sum(x) > 1e-3),
)
def test_a_split_is_complete_and_close_to_the_proportions(total, shares):
    counts = split_by_proportion(total, np.array(shares))
    assert sum(counts) == total
    assert min(counts) >= (1 if total >= len(shares) else 0)
    guaranteed = 1 if total >= len(shares) else 0
    rest = total - guaranteed * len(shares)
    for count, share in zip(counts, shares, strict=True):
        assert abs(count - guaranteed - rest * share / sum(shares)) < 1.0 + 1e-6


@pytest.mark.parametrize("shares", [[-0.1, 1.0], [0.0, 0.0]])
def test_impossible_proportions_are_refused(shares):
    with pytest.raises(ValueError, match="must not be negative, and not all zero"):
        split_by_proportion(4, np.array(shares))


def test_columns_are_blocks_by_proportion_or_equal():
    # One environment for each column, then six split 4 to 1 to 1.
    assert assign_columns(9, 3, np.array([4, 1, 1]), "cpu").tolist() == [0] * 5 + [1] * 2 + [2] * 2
    assert assign_columns(7, 3, None, "cpu").tolist() == [0, 0, 0, 1, 1, 2, 2]
    # A number of proportions that is not that of the columns says nothing about columns.
    assert assign_columns(4, 2, np.array([1.0, 0.0, 0.0]), "cpu").tolist() == [0, 0, 1, 1]


def test_origins_follow_levels_and_types():
    entity = terrain(num_envs=200, max_init_terrain_level=2)
    entity.configure_env_origins(grid(5, 4).numpy(), np.array([0.7, 0.1, 0.1, 0.1]))
    assert set(entity.terrain_levels.tolist()) == {0, 1, 2}
    assert entity.max_terrain_level == 5
    counts = torch.bincount(entity.terrain_types).tolist()
    assert counts == split_by_proportion(200, np.array([0.7, 0.1, 0.1, 0.1]))
    expected = torch.stack(
        (entity.terrain_levels, entity.terrain_types,
         100 * entity.terrain_levels + entity.terrain_types), dim=-1,
    ).float()  # fmt: skip
    assert torch.equal(entity.env_origins, expected)


def test_without_a_highest_level_environments_start_on_all_levels():
    entity = terrain(num_envs=200)
    entity.configure_env_origins(grid(3, 2))
    assert set(entity.terrain_levels.tolist()) == {0, 1, 2}


def test_environments_move_up_down_and_wrap_to_a_random_level():
    entity = terrain(num_envs=300)
    entity.configure_env_origins(grid(4, 2))
    types = entity.terrain_types.clone()
    entity.terrain_levels[:] = torch.arange(300) % 4
    before = entity.terrain_levels.clone()
    up, down = torch.zeros(2, 300, dtype=torch.bool)
    up[:200], down[200:290] = True, True
    chosen = torch.arange(295)
    entity.update_env_origins(chosen, up[:295], down[:295])
    after = entity.terrain_levels
    below_top = before[:200] < 3
    assert torch.equal(after[:200][below_top], before[:200][below_top] + 1)
    assert set(after[:200][~below_top].tolist()) == {0, 1, 2, 3}, "passed the top: anywhere"
    assert torch.equal(after[200:290], (before[200:290] - 1).clamp(min=0))
    assert torch.equal(after[290:], before[290:])
    assert torch.equal(entity.terrain_types, types)
    assert torch.equal(entity.env_origins[chosen, 2], (100 * after + types)[chosen].float())


def test_the_number_of_draws_does_not_depend_on_who_passes_the_top():
    states = []
    for level in (0, 3):
        entity = terrain(num_envs=5)
        entity.configure_env_origins(grid(4, 1))
        entity.terrain_levels[:] = level
        torch.manual_seed(0)
        entity.update_env_origins(torch.arange(5), torch.ones(5).bool(), torch.zeros(5).bool())
        states.append(torch.random.get_rng_state())
    assert torch.equal(*states)


def test_randomized_origins_cover_all_cells_and_spare_other_environments():
    entity = terrain(num_envs=400)
    entity.configure_env_origins(grid(3, 2), np.array([1.0, 0.0]))
    before = entity.env_origins.clone()
    entity.randomize_env_origins(torch.arange(300))
    assert torch.equal(entity.env_origins[300:], before[300:])
    assert len(torch.unique(entity.env_origins[:300], dim=0)) == 6


@pytest.mark.parametrize("shape", [(4, 3), (2, 2, 2), (0, 2, 3)])
def test_origins_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match="must be \\(levels, columns, 3\\)"):
        terrain().configure_env_origins(torch.zeros(shape))
