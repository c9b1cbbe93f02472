"""The page that shows terrains, without a browser."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from mjlab.scripts.visualize_terrain import VisualizeTerrainConfig, run_visualize_terrain
from mjlab.terrains.config import ALL_TERRAIN_PRESETS, flat, hf_pyramid_slope, wave_terrain
from mjlab.viewer.viser.terrain_page import (
    TerrainPage,
    add_controls,
    build_terrain_scene,
    with_values,
)


@pytest.mark.parametrize("name", ALL_TERRAIN_PRESETS)
def test_every_preset_has_knobs_for_all_but_its_place_in_the_grid(viser_server, name):
    cfg = ALL_TERRAIN_PRESETS[name]()
    controls = add_controls(viser_server.gui, cfg)
    assert set(controls) == set(vars(cfg)) - {
        "proportion", "size", "flat_patch_sampling", "downsampled_scale",
    }  # fmt: skip
    for control in controls.values():
        if hasattr(control, "min"):
            values = control.value if isinstance(control.value, tuple) else (control.value,)
            assert control.min <= min(values) <= max(values) <= control.max
    assert with_values(cfg, {field: control.value for field, control in controls.items()}) == cfg


def test_values_of_sliders_become_fields_of_a_copy():
    cfg = wave_terrain()
    changed = with_values(cfg, {"num_waves": 2, "amplitude_range": [0.1, 0.3]})
    assert (changed.num_waves, changed.amplitude_range) == (2, (0.1, 0.3))
    assert cfg == wave_terrain()


def test_a_robot_stands_at_each_origin():
    kinds = {"flat": flat(), "slope": hf_pyramid_slope()}
    scene = build_terrain_scene(kinds, 8.0, 3, 0, "unitree_go1")
    assert scene.origins.shape == (3, 2, 3)
    positions, rotations = scene.poses()
    trunk = scene.model.body("robot/trunk").id
    above = positions[:, trunk] - scene.origins.reshape(-1, 3)
    np.testing.assert_allclose(above, np.tile(above[0], (6, 1)), atol=1e-6)
    assert 0.2 < above[0, 2] < 0.5
    terrain = scene.model.body("terrain").id
    np.testing.assert_array_equal(positions[:, terrain], 0.0)
    assert rotations.shape == (6, scene.model.nbody, 3, 3)


def test_polygons_are_counted():
    scene = build_terrain_scene({"slope": hf_pyramid_slope()}, 8.0, 2, 0, "none")
    # Two fields, and the four boxes of the frame around them.
    assert scene.num_polygons == 2 * 2 * 79 * 79 + 4 * 12


def test_the_page_shows_what_its_controls_say(viser_server):
    page = TerrainPage(viser_server, "wave_terrain", num_levels=2, robot="none")
    page.rebuild()
    assert page.status.startswith("1 x 2 terrains")
    low = page.scene.model.hfield_size[1, 2]
    page._handles["amplitude_range"].value = (0.0, 0.4)
    page.rebuild()
    assert page.scene.model.hfield_size[1, 2] == pytest.approx(2 * low, rel=0.02)
    page._terrain.value = "flat"
    page.rebuild()
    assert page.scene.model.nhfield == 0
    assert page._handles == {}


def test_all_presets_are_shown_side_by_side(viser_server):
    page = TerrainPage(viser_server, "all", num_levels=1, robot="none")
    page.rebuild()
    assert page.scene.origins.shape == (1, len(ALL_TERRAIN_PRESETS), 3)


def test_the_page_keeps_the_last_valid_terrain(viser_server):
    page = TerrainPage(viser_server, "wave_terrain", num_levels=1, size=4.0, robot="none")
    page.rebuild()
    last = page.scene
    page._handles["vertical_scale"].value = -1.0
    page.rebuild()
    assert "cannot be built" in page.status
    assert page.scene is last


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"terrain": "stair"}, "'stair'; did you mean .*'pyramid_stairs'"),
        ({"num_levels": 0}, "--num-levels: .* got 0"),
        ({"size": 100.0}, "size: .* got 100.0"),
    ],
)
def test_flags_that_make_no_sense_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        run_visualize_terrain(VisualizeTerrainConfig(**fields))


@pytest.mark.slow
def test_the_module_is_a_command():
    told = subprocess.run(
        [sys.executable, "-m", "mjlab.scripts.visualize_terrain", "--help"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert told.returncode == 0
    assert "A preset of `mjlab.terrains.config`, or `all`" in told.stdout
