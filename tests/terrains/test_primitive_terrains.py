"""Sub-terrains made of boxes: their layout, and what the reference gets wrong."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.terrains import (
    BoxNarrowBeamsTerrainCfg,
    BoxNestedRingsTerrainCfg,
    BoxPyramidStairsTerrainCfg,
    BoxRandomGridTerrainCfg,
    BoxRandomSpreadTerrainCfg,
    BoxRandomStairsTerrainCfg,
    BoxSteppingStonesTerrainCfg,
)
from mjlab.terrains.boxes import merge_equal_cells
from mjlab.terrains.config import ALL_TERRAIN_PRESETS

from .ground import SIZE, Ground, ground

DIFFICULTIES = (0.0, 0.5, 1.0)


def preset(name: str, **overrides) -> Ground:
    difficulty = overrides.pop("difficulty", 1.0)
    seed = overrides.pop("seed", 0)
    return ground(ALL_TERRAIN_PRESETS[name](**({"size": SIZE} | overrides)), difficulty, seed)


# The check values of the reference, for `default_rng(0)` at difficulty 0, 0.5 and 1.


@pytest.mark.parametrize(
    ("name", "counts", "spawn", "top"),
    [
        ("flat", (1, 1, 1), (0, 0, 0), (0, 0, 0)),
        ("pyramid_stairs", (25, 25, 25), (0, 0.6, 1.2), (0, 0.6, 1.2)),
        ("pyramid_stairs_inv", (25, 25, 25), (0, -0.6, -1.2), (0, 0, 0)),
        ("box_random_grid", (325, 325, 325), (0, 0.15, 0.3), (0, 0.15, 0.3)),
        # The reference has 84 at difficulty 1: one of them, turned, reaches the spawn square.
        ("random_spread_boxes", (45, 65, 83), (0, 0, 0), (0.06, 0.18, 0.30)),
        ("open_stairs", (21, 25, 37), (0.5, 0.9, 1.8), (0.5, 0.9, 1.8)),
        ("random_stairs", (21, 21, 21), (0.2964, 0.4446, 0.5928), (0.2964, 0.4446, 0.5928)),
        ("stepping_stones", (66, 66, 66), (0.2, 0.2, 0.2), (0.2, 0.25, 0.30)),
        ("narrow_beams", (18, 18, 18), (0.2, 0.2, 0.2), (0.2, 0.2, 0.2)),
        ("nested_rings", (26, 26, 26), (0.25, 0.25, 0.25), (0.25, 0.25, 0.25)),
        # The reference has 0.41 and 0.63: it also draws a name for each column.
        ("tilted_grid", (54, 54, 54), (0.2, 0.2, 0.2), (0.2, 0.40, 0.60)),
    ],
)
def test_a_preset_has_the_check_values(name, counts, spawn, top):
    for difficulty, n, z, highest in zip(DIFFICULTIES, counts, spawn, top, strict=True):
        built = preset(name, difficulty=difficulty)
        assert built.model.ngeom == n
        assert built.origin.tolist() == pytest.approx([4.0, 4.0, z], abs=5e-5)
        digits = 5e-5 if name == "random_stairs" else 5e-3
        assert built.all_corners()[:, 2].max() == pytest.approx(highest, abs=digits)


# Stairs.


def profile(built: Ground, along: str = "x") -> list[float]:
    """Heights from the edge to the middle, each once, in order."""
    places = np.arange(0.025, 4.0, 0.05)
    found = [built.height(s, 4.0) if along == "x" else built.height(4.0, s) for s in places]
    steps = [found[0]]
    for height in found[1:]:
        if abs(height - steps[-1]) > 1e-9:
            steps.append(height)
    return steps


@pytest.mark.parametrize("along", ["x", "y"])
def test_stairs_rise_one_step_at_a_time(along):
    assert profile(preset("pyramid_stairs"), along) == pytest.approx(np.arange(7) * 0.2)
    assert profile(preset("pyramid_stairs_inv"), along) == pytest.approx(-np.arange(7) * 0.2)
    assert profile(preset("open_stairs", difficulty=0.5), along) == pytest.approx(
        np.arange(7) * 0.15
    )
    # The first step of inverted open stairs is level with the frame.
    falling = preset("open_stairs", difficulty=0.5, inverted=True)
    assert profile(falling, along) == pytest.approx(-np.arange(6) * 0.15)
    rising = profile(preset("random_stairs"), along)
    assert len(rising) == 5
    assert (np.diff(rising) >= 0.1).all()
    assert (np.diff(rising) <= 0.3).all()


@pytest.mark.parametrize("size", [(8.0, 8.0), (8.0, 11.0), (11.0, 8.0)])
def test_steps_are_as_deep_as_asked_for_on_any_rectangle(size):
    built = preset("pyramid_stairs", size=size, step_width=0.4)
    step = 0.2
    for edge, height in ((0.99, 0.0), (1.01, step), (1.39, step), (1.41, 2 * step)):
        assert built.height(edge, size[1] / 2) == pytest.approx(height)
        assert built.height(size[0] / 2, size[1] - edge) == pytest.approx(height)
        assert built.height(size[0] - edge, size[1] / 2) == pytest.approx(height)
        assert built.height(size[0] / 2, edge) == pytest.approx(height)


def test_stairs_with_holes_are_a_cross():
    built = preset("pyramid_stairs", holes=True)
    assert built.model.ngeom == 21, "no frame"
    assert built.height(4.0, 1.1) == built.height(2.6, 1.1) == pytest.approx(0.2)
    assert built.height(2.4, 1.1) == built.height(1.1, 1.1) == -np.inf


@pytest.mark.parametrize("name", ["pyramid_stairs", "pyramid_stairs_inv", "random_stairs"])
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_every_step_is_half_a_metre_thick(name, difficulty):
    """At difficulty 0 the reference's steps are sheets of 2 micrometres over nothing."""
    built = preset(name, difficulty=difficulty)
    assert (2.0 * built.model.geom_size[:, 2] >= 0.5 - 1e-9).all()


def test_a_fast_ball_does_not_fall_through_the_lowest_stairs():
    """It does through a sheet: in one time step it is below."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="terrain")
    ALL_TERRAIN_PRESETS["pyramid_stairs"](size=SIZE).function(0.0, spec, np.random.default_rng(0))
    body = spec.worldbody.add_body(name="ball", pos=(1.15, 4.0, 1.0))
    body.add_freejoint()
    body.add_geom(size=(0.03, 0.0, 0.0))
    model = spec.compile()
    data = mujoco.MjData(model)
    model.opt.timestep, data.qvel[2] = 0.005, -15.0
    mujoco.mj_step(model, data, 400)
    assert data.qpos[2] > 0.0


# Grids.


def test_a_random_grid_has_no_gap_around_the_platform():
    """The reference drops columns by their center, which leaves slots up to half a column wide."""
    built = ground(
        BoxRandomGridTerrainCfg(
            size=SIZE, grid_width=1.0, grid_height_range=(0.0, 0.3), platform_width=2.0
        )
    )
    places = np.arange(0.1, 8.0, 0.2)
    heights = built.heights(places, places)
    assert heights.min() >= -0.3 - 1e-9
    assert heights[np.ix_(abs(places - 4) < 1, abs(places - 4) < 1)] == pytest.approx(0.3)


def test_a_tilted_grid_surrounds_its_platform():
    for width, platform in ((1.0, 2.0), (1.9, 1.0), (0.7, 1.3)):
        built = preset("tilted_grid", grid_width=width, platform_width=platform)
        # Not along the seams of columns, where a ray may pass.
        places = np.arange(0.0731, 8.0, 0.2)
        assert built.heights(places, places).min() > -1.0
        inside = 4.0 + np.linspace(-0.49, 0.49, 9) * platform
        assert built.heights(inside, inside) == pytest.approx(0.2, abs=1e-6)


@pytest.mark.parametrize("size", [(8.0, 8.0), (8.0, 6.5)])
def test_a_tilted_grid_is_framed_on_all_sides(size):
    """The reference takes the frame's thickness along y from the size along x."""
    built = preset("tilted_grid", size=size, difficulty=0.0)
    xs, ys = np.linspace(0.05, size[0] - 0.05, 40), np.linspace(0.05, size[1] - 0.05, 40)
    assert built.heights(xs, ys) == pytest.approx(0.2, abs=1e-6)


def test_tilted_columns_are_tilted_planes_within_their_range():
    built = preset("tilted_grid", tilt_range_deg=20.0, height_range=0.3)
    meshes = built.model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    limit = np.deg2rad(20.0)
    slopes = []
    for geom in np.flatnonzero(meshes):
        points = built.corners(geom)
        assert len(points) == 8
        tops = points[points[:, 2] > -1.0]
        plane, residual, *_ = np.linalg.lstsq(
            np.column_stack((tops[:, :2] - tops[:, :2].mean(axis=0), np.ones(4))), tops[:, 2]
        )
        assert residual.sum() < 1e-9
        assert abs(plane[2] - 0.2) <= 0.15 + 1e-6
        slopes.append(plane[:2])
    assert (abs(np.array(slopes)) <= limit + 1e-5).all()
    assert abs(np.array(slopes)).max() > 0.8 * limit


def test_the_columns_of_a_cross_are_kept_in_a_grid_with_holes():
    built = preset("box_random_grid", grid_width=1.0, platform_width=2.0, holes=True)
    assert built.height(1.2, 4.0) > -1.0
    assert built.height(4.0, 6.8) > -1.0
    assert built.height(1.2, 1.2) == -np.inf
    assert built.height(0.2, 0.2) == 0.0, "the frame stays"


def test_merging_heights_takes_fewer_boxes():
    plain = preset("box_random_grid")
    merged = preset("box_random_grid", merge_similar_heights=True, height_merge_threshold=0.1)
    assert merged.model.ngeom < 0.8 * plain.model.ngeom
    places = np.arange(0.05, 8.0, 0.2)
    apart = abs(merged.heights(places, places) - plain.heights(places, places))
    assert apart.max() <= 0.05 + 1e-9


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4), st.integers(0, 10**6))
@settings(max_examples=60)
def test_merged_rectangles_hold_every_kept_cell_once_and_are_of_one_value(rows, cols, most, seed):
    rng = np.random.default_rng(seed)
    values, kept = rng.integers(0, 3, (rows, cols)), rng.random((rows, cols)) < 0.8
    times = np.zeros((rows, cols), dtype=int)
    for i, j, num_i, num_j in merge_equal_cells(values, kept, most):
        assert 1 <= num_i <= most
        assert 1 <= num_j <= most
        block = (slice(i, i + num_i), slice(j, j + num_j))
        times[block] += 1
        assert (values[block] == values[i, j]).all()
    assert np.array_equal(times, kept.astype(int))


# Boxes that lie about.


@pytest.mark.parametrize("seed", range(10))
def test_no_box_reaches_into_the_spawn_square(seed):
    """The reference tests boxes before it turns them: 18 of 30 seeds have one in the square."""
    built = preset("random_spread_boxes", seed=seed)
    inside = 4.0 + np.linspace(-0.499, 0.499, 15)
    assert built.heights(inside, inside).max() == 0.0


def test_boxes_spread_over_the_terrain_and_are_turned():
    built = preset("random_spread_boxes")
    boxes = slice(5, None)
    assert (built.model.geom_pos[boxes, :2].std(axis=0) > 1.5).all()
    turned = abs(built.model.geom_quat[boxes, 3])
    assert (turned > 0.1).mean() > 0.8


def test_without_a_floor_there_is_only_a_platform():
    built = preset("random_spread_boxes", num_boxes=0, add_floor=False)
    assert built.height(4.0, 4.0) == 0.0
    assert built.height(2.0, 2.0) == -np.inf
    assert built.height(0.1, 0.1) == 0.0


# Over a pit.


@pytest.mark.parametrize("name", ["stepping_stones", "narrow_beams", "nested_rings", "tilted_grid"])
def test_a_pit_has_a_floor_as_deep_as_asked_for(name):
    built = preset(name, floor_depth=1.5)
    lowest = built.heights(np.arange(0.05, 8, 0.1), np.arange(0.05, 8, 0.1)).min()
    if name != "tilted_grid":
        assert lowest == pytest.approx(-1.5)
    assert (built.all_corners()[:, 2].min()) == pytest.approx(-2.0)


def test_the_gap_around_the_platform_is_that_between_stones():
    built = preset("stepping_stones", difficulty=0.0)
    step = 0.002
    # Along a row of stones; the outermost lie against the frame.
    pit = built.heights(np.arange(step / 2, 8.0, step), np.array([3.5])).ravel() < 0.0
    edges = np.flatnonzero(np.diff(pit.astype(int)))
    gaps = (edges[1::2] - edges[::2]) * step
    assert len(gaps) == 6
    assert gaps == pytest.approx(7.5 / 7 - 0.8, abs=2 * step)


def test_stones_shrink_with_difficulty_and_keep_their_places():
    easy, hard = (
        preset("stepping_stones", difficulty=d, stone_size_variation=0.0, displacement_range=0.0)
        for d in (0.0, 1.0)
    )
    inner = [k for k in range(6, easy.model.ngeom) if easy.model.geom_size[k, 0] > 0.39]
    assert easy.model.geom_size[inner, :2].max() == pytest.approx(0.4)
    assert 2.0 * hard.model.geom_size[6:, :2].max() == pytest.approx(0.4)
    assert easy.model.ngeom == hard.model.ngeom


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
@pytest.mark.parametrize("size", [(8.0, 8.0), (8.0, 5.0)])
def test_beams_lead_from_the_platform_to_the_frame(size, difficulty):
    built = preset("narrow_beams", size=size, difficulty=difficulty)
    for k in range(12):
        direction = np.array([np.cos(np.pi * k / 6), np.sin(np.pi * k / 6)])
        reach = np.min(np.array(size) / 2 / np.maximum(abs(direction), 1e-9))
        for distance in np.linspace(0.0, reach - 0.01, 40):
            x, y = np.array(size) / 2 + distance * direction
            assert built.height(x, y) == pytest.approx(0.2), (k, distance)


def test_a_ring_that_fills_the_middle_has_no_empty_sides():
    built = ground(
        BoxNestedRingsTerrainCfg(
            size=(3.0, 3.0), border_width=0.25, platform_width=0.0, ring_width_range=(1.0, 1.0),
            gap_range=(0.1, 0.1),
        )
    )  # fmt: skip
    assert (built.model.geom_size >= 0.005).all()
    assert built.height(1.5, 1.5) == pytest.approx(0.25)


# Odd configs.


@pytest.mark.parametrize(
    "cfg",
    [
        BoxPyramidStairsTerrainCfg(step_height_range=(0, 0.1), step_width=-0.3),
        BoxPyramidStairsTerrainCfg(step_height_range=(0, 0.1), step_width=0.3, platform_width=-1.0),
        BoxRandomStairsTerrainCfg(step_width=-1.0),
        BoxRandomStairsTerrainCfg(border_width=-1.0),
        BoxRandomGridTerrainCfg(
            size=SIZE, grid_width=1.0, grid_height_range=(0.3, 0.0), max_merge_distance=0,
            merge_similar_heights=True,
        ),
        BoxRandomSpreadTerrainCfg(num_boxes=-1),
        BoxRandomSpreadTerrainCfg(box_width_range=(0.0, 0.3)),
        BoxRandomGridTerrainCfg(size=(8, 6), grid_width=0.4, grid_height_range=(0, 0.3)),
        BoxRandomGridTerrainCfg(
            size=SIZE, grid_width=0.5, grid_height_range=(0, 1), border_width=0.0
        ),
        BoxSteppingStonesTerrainCfg(floor_depth=0.0),
        BoxSteppingStonesTerrainCfg(stone_size_range=(0.8, 0.4)),
        BoxNarrowBeamsTerrainCfg(beam_width_range=(0.4, 0.2), num_beams=9.0),  # ty: ignore
        BoxNestedRingsTerrainCfg(gap_range=(0.2, -0.1)),
    ],
)  # fmt: skip
def test_values_of_other_releases_are_accepted(cfg):
    built = ground(cfg)
    assert (built.model.geom_size[:, :2] > 0.0).all()


def test_beams_may_widen_with_the_difficulty():
    widths = []
    for difficulty, ends in ((0.0, (0.4, 0.2)), (1.0, (0.2, 0.4))):
        built = ground(BoxNarrowBeamsTerrainCfg(beam_width_range=ends), difficulty)
        widths.append(built.model.geom_size[-1, 1])
    assert widths[0] == widths[1]
