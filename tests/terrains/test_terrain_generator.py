"""Tests of the sub-terrain grid: positions, types and difficulties of cells, and the border."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.terrains import (
    BoxPyramidStairsTerrainCfg,
    FlatPatchSamplingCfg,
    SubTerrainCfg,
    TerrainGenerator,
    TerrainGeneratorCfg,
)
from mjlab.terrains.config import ALL_TERRAIN_PRESETS, ROUGH_TERRAINS_CFG
from mjlab.terrains.terrain_generator import TerrainGeometry, TerrainOutput
from mjlab.terrains.utils import make_plane

from .ground import Ground, compiled

RED = (0.9, 0.1, 0.2, 1.0)


@dataclasses.dataclass(kw_only=True)
class Recorder(SubTerrainCfg):
    """A flat box that keeps what it was called with."""

    calls: list = dataclasses.field(default_factory=list)
    draws: int = 0
    patches: int = 0

    def function(self, difficulty, spec, rng):
        self.calls.append((difficulty, self.size, rng.random(self.draws)))
        geoms = make_plane(spec.body("terrain"), self.size, 0.5, center_zero=False)
        origin = np.array([self.size[0] / 2, self.size[1] / 2, 0.5])
        found = {"spawn": np.arange(3.0 * self.patches).reshape(-1, 3)} if self.patches else None
        return TerrainOutput(origin, [TerrainGeometry(geom=geoms[0], color=RED)], found)


def generator_cfg(**fields) -> TerrainGeneratorCfg:
    given = {"seed": 1, "size": (4.0, 6.0), "sub_terrains": {"one": Recorder()}}
    return TerrainGeneratorCfg(**(given | fields))


def build(**fields) -> tuple[TerrainGenerator, Ground]:
    generator, spec = TerrainGenerator(generator_cfg(**fields)), mujoco.MjSpec()
    generator.compile(spec)
    return generator, compiled(spec)


# Layout.


def test_rows_lie_along_x_and_columns_along_y_about_the_origin():
    generator, built = build(num_rows=3, num_cols=2)
    assert generator.terrain_origins.shape == (3, 2, 3)
    assert generator.terrain_origins[0, 0].tolist() == [-4.0, -3.0, 0.5]
    assert generator.terrain_origins[2, 1].tolist() == [4.0, 3.0, 0.5]
    corners = built.all_corners()
    assert corners.min(axis=0)[:2].tolist() == [-6.0, -6.0]
    assert corners.max(axis=0)[:2].tolist() == [6.0, 6.0]
    assert built.model.body("terrain").id == 1


@given(st.integers(1, 6), st.integers(1, 6), st.floats(0.5, 20.0), st.floats(0.5, 20.0))
@settings(max_examples=20)
def test_origins_are_the_middles_of_cells(rows, cols, size_x, size_y):
    generator, _ = build(num_rows=rows, num_cols=cols, size=(size_x, size_y))
    for row in range(rows):
        for col in range(cols):
            expected = ((row - rows / 2 + 0.5) * size_x, (col - cols / 2 + 0.5) * size_y, 0.5)
            assert generator.terrain_origins[row, col] == pytest.approx(expected)


def test_a_curriculum_has_one_column_a_kind_and_harder_rows():
    kinds = {name: Recorder(proportion=share) for name, share in (("b", 5.0), ("a", 0.0))}
    generator, _ = build(
        curriculum=True, num_rows=5, num_cols=7, sub_terrains=kinds, difficulty_range=(0.2, 0.6)
    )
    assert generator.terrain_origins.shape == (5, 2, 3)
    for kind in kinds.values():
        difficulties = [difficulty for difficulty, _, _ in kind.calls]
        assert difficulties == pytest.approx([0.2, 0.3, 0.4, 0.5, 0.6])


def test_a_curriculum_of_one_row_is_of_the_lowest_difficulty():
    kind = Recorder()
    build(curriculum=True, num_rows=1, sub_terrains={"a": kind}, difficulty_range=(0.3, 0.8))
    assert [difficulty for difficulty, _, _ in kind.calls] == [0.3]


def test_random_grids_have_an_order_of_draws():
    kinds = {"a": Recorder(proportion=3.0, draws=2), "b": Recorder(proportion=1.0, draws=1)}
    build(num_rows=3, num_cols=4, sub_terrains=kinds, seed=5, difficulty_range=(0.1, 0.7))
    rng, expected = np.random.default_rng(5), {"a": [], "b": []}
    for _ in range(12):
        name = ("a", "b")[rng.choice(2, p=[0.75, 0.25])]
        difficulty = rng.uniform(0.1, 0.7)
        expected[name].append((difficulty, rng.random(kinds[name].draws).tolist()))
    for name, kind in kinds.items():
        assert [(call[0], call[2].tolist()) for call in kind.calls] == expected[name]


def test_kinds_come_in_their_proportions():
    kinds = {
        "a": Recorder(proportion=0.6),
        "b": Recorder(proportion=0.2),
        "c": Recorder(proportion=0),
    }
    build(num_rows=20, num_cols=20, sub_terrains=kinds)
    counts = {name: len(kind.calls) for name, kind in kinds.items()}
    assert counts["a"] + counts["b"] == 400
    assert abs(counts["a"] - 300) < 45
    assert counts["c"] == 0


def test_configs_stay_as_they_are():
    """The reference writes its own size into the user's sub-terrains."""
    shared = Recorder(size=(1.0, 2.0))
    cfg = generator_cfg(sub_terrains={"a": shared})
    before = dataclasses.asdict(cfg)
    TerrainGenerator(cfg)
    TerrainGenerator(dataclasses.replace(cfg, size=(9.0, 9.0))).compile(mujoco.MjSpec())
    assert shared.calls[0][1] == (9.0, 9.0)
    assert shared.size == (1.0, 2.0)
    shared.calls.clear()
    assert dataclasses.asdict(cfg) == before


# Repeatability and names.


def binary(seed: int | None) -> bytes:
    """All of the compiled model, names and textures included."""
    presets = {name: ALL_TERRAIN_PRESETS[name]() for name in sorted(ALL_TERRAIN_PRESETS)}
    presets.pop("box_random_grid")
    fields = {"sub_terrains": presets, "num_rows": 3, "num_cols": 3, "border_width": 1.0}
    _, built = build(size=(8.0, 8.0), seed=seed, **fields)
    buffer = np.zeros(mujoco.mj_sizeModel(built.model), dtype=np.uint8)
    mujoco.mj_saveModel(built.model, None, buffer)
    return buffer.tobytes()


def test_one_seed_gives_one_terrain_down_to_the_names():
    """The reference's names hold random numbers."""
    assert binary(seed=4) == binary(seed=4)
    assert binary(seed=4) != binary(seed=5)


def test_without_a_seed_the_global_one_decides():
    np.random.seed(3)
    first = binary(seed=None)
    np.random.seed(3)
    assert binary(seed=None) == first
    np.random.seed(4)
    assert binary(seed=None) != first


def test_names_of_geoms_and_assets():
    kinds = {"slope": ALL_TERRAIN_PRESETS["hf_pyramid_slope"](),
             "tilt": ALL_TERRAIN_PRESETS["tilted_grid"]()}  # fmt: skip
    _, built = build(
        curriculum=True, num_rows=2, sub_terrains=kinds, size=(8.0, 8.0), border_width=1.0
    )
    model = built.model
    names = [model.geom(k).name for k in range(model.ngeom)]
    assert names == [f"terrain_{k}" for k in range(model.ngeom)]
    assert model.hfield(0).name == "hfield_0"
    names = [model.hfield(k).name for k in range(2)] + [model.mesh(k).name for k in range(96)]
    assert model.nmesh == 96
    assert len(set(names)) == 98


# Colors, border and light.


@pytest.mark.parametrize(("scheme", "expected"), [("height", RED), ("none", (0.5, 0.5, 0.5, 1.0))])
def test_a_scheme_colors_the_ground(scheme, expected):
    _, built = build(num_rows=2, color_scheme=scheme)
    assert built.model.geom_rgba == pytest.approx(np.tile(expected, (2, 1)), abs=1e-6)


def test_random_colors_are_drawn_from_the_terrains_own_generator():
    _, built = build(num_rows=2, color_scheme="random", seed=3, border_width=1.0)
    rng = np.random.default_rng(3)
    for k in range(2):
        rng.choice(1, p=[1.0])
        rng.uniform(0.0, 1.0)
        expected = (*rng.uniform(0.3, 0.8, 3), 1.0)
        assert built.model.geom_rgba[k] == pytest.approx(expected, abs=1e-6)
    assert built.model.geom_rgba[2:] == pytest.approx(np.tile((*rng.random(3), 1), (4, 1)))


def test_height_fields_keep_their_texture():
    _, built = build(sub_terrains={"a": ALL_TERRAIN_PRESETS["hf_pyramid_slope"]()}, size=(8.0, 8.0))
    assert built.model.geom_matid[0] >= 0


def test_a_border_is_flat_ground_around_the_grid():
    _, built = build(num_rows=2, num_cols=3, border_width=2.5, border_height=0.8)
    assert built.model.ngeom == 6 + 4
    for x, y in ((6.4, 0.0), (-6.4, 0.0), (0.0, 11.4), (0.0, -11.4), (6.4, 11.4), (-6.4, -11.4)):
        assert built.height(x, y) == pytest.approx(0.0)
    assert built.height(6.6, 0.0) == built.height(0.0, 11.6) == -np.inf
    frame = built.model.geom_pos[6:], built.model.geom_size[6:]
    assert [tuple(p) for p in np.sign(np.round(frame[0][:, :2], 9))] == [
        (0, 1), (0, -1), (-1, 0), (1, 0),
    ]  # fmt: skip
    assert frame[0][:, 2].tolist() == pytest.approx([-0.4] * 4)
    assert frame[1][0].tolist() == pytest.approx([6.5, 1.25, 0.4])
    assert built.model.geom_rgba[6:] == pytest.approx(np.tile((0.2, 0.2, 0.2, 1), (4, 1)))


def test_a_negative_border_height_makes_a_wall():
    _, built = build(border_width=0.5, border_height=-1.5)
    assert built.height(2.25, 0.0) == built.height(0.0, -3.25) == pytest.approx(1.5)
    assert built.all_corners()[:, 2].min() == pytest.approx(-0.5), "the wall stands on z = 0"


def test_a_light_shines_down_on_the_whole_grid():
    assert build()[1].model.nlight == 0
    _, built = build(num_rows=3, num_cols=4, add_lights=True)
    light = built.model.light(0)
    assert light.type[0] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    assert light.pos.tolist() == pytest.approx([0.0, 0.0, 0.6 * 24.0])
    assert light.dir.tolist() == [0.0, 0.0, -1.0]
    assert light.bodyid[0] == built.model.body("terrain").id


# Flat patches.


def sampling(number: Any, radius: float) -> dict[str, FlatPatchSamplingCfg]:
    return {"spawn": FlatPatchSamplingCfg(num_patches=number, patch_radius=radius)}


def test_flat_patches_lie_in_their_cells():
    kinds = {
        "few": Recorder(flat_patch_sampling=sampling(2, 0.7), patches=2),
        "none": Recorder(),
        "many": Recorder(flat_patch_sampling=sampling(3, 0.2), patches=3),
    }
    generator, _ = build(curriculum=True, num_rows=2, sub_terrains=kinds)
    patches = generator.flat_patches["spawn"]
    assert patches.shape == (2, 3, 3, 3)
    assert generator.flat_patch_radii == {"spawn": 0.7}
    corner = generator.terrain_origins - np.array([2.0, 3.0, 0.5])
    assert patches[1, 2] == pytest.approx(corner[1, 2] + np.arange(9.0).reshape(3, 3))
    assert patches[0, 0, :2] == pytest.approx(corner[0, 0] + np.arange(6.0).reshape(2, 3))
    assert patches[0, 0, 2].tolist() == generator.terrain_origins[0, 0].tolist()
    for row in range(2):
        assert (patches[row, 1] == generator.terrain_origins[row, 1]).all()


def test_unrequested_flat_patches_are_dropped():
    generator, _ = build(sub_terrains={"a": Recorder(patches=2)}, num_rows=2, num_cols=3)
    assert not generator.flat_patches


# Odd configs.


def test_a_grid_needs_a_sub_terrain():
    with pytest.raises(ValueError, match="sub_terrains: expected at least one"):
        TerrainGenerator(generator_cfg(sub_terrains={}))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"num_rows": 0}, "num_rows: expected .*got 0"),
        ({"num_cols": -1}, "num_cols: expected .*got -1"),
        ({"num_rows": 10**6, "num_cols": 10**6}, "cells: expected at most .*got 1,000,000,000,000"),
    ],
)
def test_numbers_of_cells_are_positive_and_fit(fields, message):
    with pytest.raises(ValueError, match=message):
        TerrainGenerator(generator_cfg(**fields))


@pytest.mark.parametrize("ends", [(0.8, 0.2), (0.0, 1.5), (-0.2, 0.5)])
def test_difficulties_are_those_of_the_range(ends):
    stairs = BoxPyramidStairsTerrainCfg(
        step_height_range=(0.0, 0.2), step_width=0.3, platform_width=1.0, border_width=0.25
    )
    generator, _ = build(
        size=(4.0, 4.0), curriculum=True, num_rows=2, sub_terrains={"s": stairs},
        difficulty_range=ends,
    )  # fmt: skip
    # Four steps and the platform, of 0.2 m each at difficulty 1.
    assert generator.terrain_origins[:, 0, 2] == pytest.approx(np.array(ends))


def test_an_error_of_a_sub_terrain_says_which_one_it_is():
    kinds = {"rough": ALL_TERRAIN_PRESETS["random_rough"](noise_step=0.0)}
    with pytest.raises(ValueError, match="Sub-terrain 'rough' at difficulty .*noise_step"):
        build(sub_terrains=kinds)


# Size and time.


def test_the_rough_terrain_of_the_tasks_is_of_a_moderate_size():
    spec = mujoco.MjSpec()
    TerrainGenerator(dataclasses.replace(ROUGH_TERRAINS_CFG, seed=0)).compile(spec)
    model = spec.compile()
    assert model.ngeom < 3000
    assert model.nmesh == 0
