"""Tests of the terrain entity and its environment origins."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.scene import Scene, SceneCfg
from mjlab.terrains import (
    FlatPatchSamplingCfg,
    TerrainEntity,
    TerrainEntityCfg,
    TerrainGeneratorCfg,
)
from mjlab.terrains.config import flat, hf_pyramid_slope, pyramid_stairs
from mjlab.terrains.terrain_entity import assign_columns, grid_origins, split_by_proportion
from mjlab.utils.state import capture_state, restore_state, shape_differences


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
    with pytest.raises(ValueError, match="env_spacing: .*got None"):
        terrain(env_spacing=None)
    with pytest.raises(ValueError, match="terrain_generator: .*'generator', got None"):
        terrain(terrain_type="generator")
    with pytest.raises(ValueError, match="terrain_type: .*'plane', 'generator'.*'hills'"):
        terrain(terrain_type="hills")
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
    with pytest.raises(ValueError, match=r"got \[(-0\.1, 1\.0|0\.0, 0\.0)\]"):
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


# A generated terrain, as an entity.

PATCHES = {"spawn": FlatPatchSamplingCfg(num_patches=3, patch_radius=0.4)}


def generated(num_envs: int = 50, *, entity: dict | None = None, **fields) -> TerrainEntity:
    given = {
        "seed": 1,
        "curriculum": True,
        "size": (8.0, 8.0),
        "num_rows": 4,
        "sub_terrains": {
            "flat": flat(proportion=0.7),
            "stairs": pyramid_stairs(proportion=0.1),
            "slope": hf_pyramid_slope(proportion=0.2, flat_patch_sampling=PATCHES),
        },
    }
    return terrain(
        num_envs=num_envs,
        terrain_type="generator",
        terrain_generator=TerrainGeneratorCfg(**(given | fields)),
        **(entity or {}),
    )


def test_environments_start_on_the_cells_of_their_level_and_column():
    entity = generated(entity={"max_init_terrain_level": 2})
    assert entity.terrain_origins.shape == (4, 3, 3)
    assert entity.max_terrain_level == 4
    assert entity.terrain_generator.num_cols == 3
    assert set(entity.terrain_levels.tolist()) == {0, 1, 2}
    expected = entity.terrain_origins[entity.terrain_levels, entity.terrain_types]
    assert torch.equal(entity.env_origins, expected)
    # The stairs of row r are as high as its difficulty, and its spawn point is on top.
    heights = entity.terrain_origins[:, 1, 2]
    torch.testing.assert_close(heights, torch.tensor([0.0, 0.4, 0.8, 1.2]))


def test_a_generated_terrain_is_one_static_body(recwarn, caplog):
    entity = generated()
    assert not recwarn.list, "no word about a plane that is not there"
    assert not caplog.messages
    model = entity.compile()
    assert entity.body_names == ("terrain",)
    assert (model.nbody, model.nmocap) == (2, 0)
    ground = model.mat("groundplane").id
    assert not (model.geom_matid == ground).any()
    assert model.light("sun").type[0] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL


def test_shares_of_environments_follow_proportions_in_a_curriculum_only():
    """In a random grid with as many columns as kinds, columns do not hold one kind each."""
    counts = torch.bincount(generated(100).terrain_types).tolist()
    assert counts == split_by_proportion(100, np.array([0.7, 0.1, 0.2]))
    random = generated(99, curriculum=False, num_cols=3)
    assert torch.bincount(random.terrain_types).tolist() == [33, 33, 33]


def test_flat_patches_are_tensors_of_every_cell():
    entity = generated()
    patches = entity.flat_patches["spawn"]
    assert patches.shape == (4, 3, 3, 3)
    assert patches.dtype == torch.float32
    assert entity.flat_patch_radii == {"spawn": 0.4}
    for col in (0, 1):
        expected = entity.terrain_origins[:, col, None].expand(-1, 3, -1)
        torch.testing.assert_close(patches[:, col], expected)
    # Those of the slope are in their own cells.
    middle = entity.terrain_origins[:, 2, None, :2]
    assert ((patches[:, 2, :, :2] - middle).abs() <= 4.0).all()
    assert (patches[:, 2, 0] != entity.terrain_origins[:, 2]).any()


def test_debug_sites_show_spawn_points_and_flat_patches():
    entity = generated(3, entity={"debug_vis": True})
    model = entity.compile()
    assert model.nsite == 3 + 12 + 4 * 3 * 3
    site = model.site("terrain_origin_3_1")
    assert site.pos.tolist() == pytest.approx(entity.terrain_origins[3, 1].tolist())
    assert (site.size[0], site.group[0]) == (0.5, 5)
    site = model.site("flat_patch_spawn_2_2_1")
    assert site.pos.tolist() == pytest.approx(entity.flat_patches["spawn"][2, 2, 1].tolist())
    assert site.size.tolist() == pytest.approx([0.4, 0.4, 0.02])
    assert (site.type[0], site.group[0]) == (mujoco.mjtGeom.mjGEOM_BOX, 3)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=12))
@settings(max_examples=30)
def test_levels_move_by_one_and_only_those_that_pass_the_top_jump(moves):
    entity = terrain(num_envs=6)
    entity.configure_env_origins(grid(3, 2))
    for up, down in moves:
        before = entity.terrain_levels.clone()
        entity.update_env_origins(torch.arange(6), *(torch.tensor([x] * 6) for x in (up, down)))
        after, step = entity.terrain_levels, int(up) - int(down)
        expected = (before + step).clamp(min=0)
        stays_on = before + step < 3
        assert torch.equal(after[stays_on], expected[stays_on])
        assert ((after >= 0) & (after < 3)).all()
        origins = entity.terrain_origins[after, entity.terrain_types]
        assert torch.equal(entity.env_origins, origins)


def test_a_reset_without_moves_leaves_levels_where_they_started():
    entity = generated(entity={"max_init_terrain_level": 1})
    levels, origins = entity.terrain_levels.clone(), entity.env_origins.clone()
    none = torch.zeros(50, dtype=torch.bool)
    entity.update_env_origins(torch.arange(50), none, none)
    assert torch.equal(entity.terrain_levels, levels)
    assert torch.equal(entity.env_origins, origins)


def test_levels_and_columns_are_part_of_a_checkpoint():
    entity = generated()
    entity.randomize_env_origins(torch.arange(50))
    saved = capture_state(entity)
    other = generated()
    kept = other.env_origins
    restore_state(other, saved)
    for name in ("terrain_levels", "terrain_types", "env_origins"):
        assert torch.equal(getattr(other, name), getattr(entity, name))
    assert other.env_origins is kept, "terms may hold the tensor"
    # A state of another grid is recognised.
    assert shape_differences(saved, capture_state(generated(num_rows=3)))


def test_a_scene_with_a_generated_terrain_leaves_its_config_alone():
    cfg = TerrainEntityCfg(
        terrain_type="generator",
        terrain_generator=TerrainGeneratorCfg(
            seed=0, size=(8.0, 8.0), num_rows=2, num_cols=2, sub_terrains={"a": pyramid_stairs()}
        ),
    )
    scene = Scene(SceneCfg(num_envs=5, terrain=cfg), device="cpu")
    assert scene.terrain.env_origins.shape == (5, 3)
    assert (cfg.num_envs, cfg.env_spacing) == (1, 2.0)
    assert cfg.terrain_generator.sub_terrains["a"].size == (10.0, 10.0)
    assert scene.compile().body("terrain").geomnum[0] == 4 * 25
