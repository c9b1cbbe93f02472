"""Laws of every sub-terrain type, at every difficulty."""

from __future__ import annotations

import dataclasses
import inspect

import mujoco
import numpy as np
import pytest

from mjlab.terrains import SubTerrainCfg, TerrainGenerator, TerrainGeneratorCfg
from mjlab.terrains import heightfield_terrains as hf
from mjlab.terrains import primitive_terrains as box
from mjlab.terrains.config import ALL_TERRAIN_PRESETS

from .ground import SIZE, Ground, ground

PRESETS = sorted(ALL_TERRAIN_PRESETS)
DIFFICULTIES = (0.0, 0.5, 1.0)
# Presets without random numbers.
WITHOUT_CHANCE = {
    "flat", "pyramid_stairs", "pyramid_stairs_inv", "hf_pyramid_slope", "hf_pyramid_slope_inv",
    "wave_terrain", "open_stairs", "narrow_beams", "nested_rings",
}  # fmt: skip
# Radius of the area around the spawn point that a robot's feet may touch (m).
FEET = 0.45


def preset(name: str) -> SubTerrainCfg:
    return ALL_TERRAIN_PRESETS[name](size=SIZE)


def fingerprint(ground: Ground) -> dict[str, np.ndarray]:
    model = ground.model
    names = ("geom_pos", "geom_quat", "geom_size", "geom_rgba", "mesh_vert", "hfield_data")
    arrays = {name: getattr(model, name).copy() for name in (*names, "hfield_size", "tex_data")}
    return arrays | {"origin": ground.origin}


def test_there_is_a_preset_of_every_kind():
    kinds = {
        cls
        for module in (box, hf)
        for _, cls in inspect.getmembers(module, inspect.isclass)
        if issubclass(cls, SubTerrainCfg) and cls is not SubTerrainCfg
    }
    assert len(kinds) == 16
    assert {type(preset(name)) for name in PRESETS} == kinds


@pytest.mark.parametrize("seed", [0, 7])
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
@pytest.mark.parametrize("name", PRESETS)
def test_a_sub_terrain_is_sound(name, difficulty, seed):
    cfg = preset(name)
    built = ground(cfg, difficulty, seed)
    x, y, z = built.origin
    assert (x, y) == (SIZE[0] / 2, SIZE[1] / 2)
    # The spawn point is on the ground, which nowhere under the feet is above it.
    around = np.linspace(-FEET, FEET, 7)
    under_feet = built.heights(x + around, y + around)
    assert under_feet.max() <= z + 1e-6, "the robot would start inside the ground"
    if not name.startswith(("perlin", "random_rough", "wave")):
        assert built.height(x, y) == pytest.approx(z, abs=0.01)
    else:
        # Here the spawn point is at the highest ground within a metre.
        near = np.linspace(-1.0, 1.0, 41)
        assert built.heights(x + near, y + near).max() >= z - 0.02
    # Everything is in its cell.
    corners = built.all_corners()
    assert (corners[:, :2] >= -1e-6).all()
    assert (corners[:, :2] <= np.array(SIZE) + 1e-6).all()
    assert_nothing_degenerate(cfg, built.model)
    # The output lists all geoms of the spec: the generator colors and moves only those.
    assert len(built.output.geometries) == built.model.ngeom


def assert_nothing_degenerate(cfg: SubTerrainCfg, model: mujoco.MjModel) -> None:
    boxes = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    fields = model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD
    assert (model.geom_size[boxes] >= 0.02).all()
    # No thin sheets, except slabs of open stairs; their border is solid too.
    thinnest = 2.0 * model.geom_size[boxes, 2].min(initial=np.inf)
    slabs = getattr(cfg, "step_thickness", None)
    assert thinnest == pytest.approx(slabs) if slabs else thinnest >= 0.5 - 1e-6
    assert (model.hfield_size[model.geom_dataid[fields], 3] >= 0.5 - 1e-6).all()
    assert (np.isfinite(model.hfield_data)).all()


@pytest.mark.parametrize("name", PRESETS)
def test_the_seed_decides_the_terrain(name):
    first, again, other = (fingerprint(ground(preset(name), 1.0, seed)) for seed in (3, 3, 4))
    for field, values in first.items():
        assert np.array_equal(values, again[field]), field
    differs = any(
        values.shape != other[field].shape or not np.array_equal(values, other[field])
        for field, values in first.items()
    )
    assert differs == (name not in WITHOUT_CHANCE)


@pytest.mark.parametrize("name", PRESETS)
def test_building_leaves_the_config_as_it_was(name):
    cfg = preset(name)
    before = dataclasses.asdict(cfg)
    ground(cfg, 0.7)
    assert dataclasses.asdict(cfg) == before


@pytest.mark.parametrize("curriculum", [False, True])
def test_all_kinds_stand_in_one_grid_where_the_generator_says(curriculum):
    cfg = TerrainGeneratorCfg(
        seed=2, curriculum=curriculum, size=SIZE, num_rows=2, num_cols=9,
        sub_terrains={name: ALL_TERRAIN_PRESETS[name]() for name in PRESETS},
    )  # fmt: skip
    generator, spec = TerrainGenerator(cfg), mujoco.MjSpec()
    generator.compile(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    built = Ground(spec, model, data)
    around = np.linspace(-FEET, FEET, 3)
    for x, y, z in generator.terrain_origins.reshape(-1, 3):
        # Whatever stands there is the ground of this cell: no neighbor reaches over.
        assert built.heights(x + around, y + around).max() <= z + 1e-6
        assert built.height(x, y) >= z - 0.7
