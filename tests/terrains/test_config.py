"""Presets, and the sets of them."""

from __future__ import annotations

import pytest

from mjlab.terrains import BoxFlatTerrainCfg, BoxPyramidStairsTerrainCfg, SubTerrainCfg
from mjlab.terrains.config import (
    ALL_TERRAIN_PRESETS,
    ALL_TERRAINS_CFG,
    ROUGH_TERRAINS_CFG,
    STAIRS_TERRAINS_CFG,
    pyramid_stairs,
    terrain_preset,
)


def test_a_keyword_overrides_a_figure_of_a_preset():
    assert pyramid_stairs() == BoxPyramidStairsTerrainCfg(
        border_width=1.0, step_height_range=(0.0, 0.2), step_width=0.3, platform_width=3.0
    )
    changed = pyramid_stairs(step_width=0.5, proportion=0.1)
    assert (changed.step_width, changed.proportion, changed.platform_width) == (0.5, 0.1, 3.0)


@pytest.mark.parametrize("name", ALL_TERRAIN_PRESETS)
def test_every_preset_makes_a_new_config_that_takes_a_size(name):
    preset = ALL_TERRAIN_PRESETS[name]
    first, second = preset(size=(3.0, 4.0)), preset()
    assert isinstance(first, SubTerrainCfg)
    assert first.size == (3.0, 4.0)
    assert first is not preset(size=(3.0, 4.0))
    assert second.proportion == 1.0


def test_a_preset_registers_under_its_name_once(monkeypatch):
    for name in list(ALL_TERRAIN_PRESETS):
        monkeypatch.setitem(ALL_TERRAIN_PRESETS, name, ALL_TERRAIN_PRESETS[name])

    def my_ground(**overrides):
        return BoxFlatTerrainCfg(**overrides)

    try:
        assert terrain_preset(my_ground) is my_ground
        assert ALL_TERRAIN_PRESETS["my_ground"] is my_ground
        with pytest.raises(ValueError, match="'my_ground'"):
            terrain_preset(my_ground)
    finally:
        del ALL_TERRAIN_PRESETS["my_ground"]


def test_the_sets_are_those_of_the_reference():
    for cfg in (ROUGH_TERRAINS_CFG, ALL_TERRAINS_CFG, STAIRS_TERRAINS_CFG):
        assert (cfg.size, cfg.border_width, cfg.num_rows, cfg.add_lights) == ((8, 8), 20, 10, True)
    assert [cfg.curriculum for cfg in (ROUGH_TERRAINS_CFG, ALL_TERRAINS_CFG, STAIRS_TERRAINS_CFG)] == [
        False, False, True,
    ]  # fmt: skip
    assert ROUGH_TERRAINS_CFG.num_cols == 20
    assert {name: sub.proportion for name, sub in ROUGH_TERRAINS_CFG.sub_terrains.items()} == {
        "flat": 0.2, "pyramid_stairs": 0.2, "pyramid_stairs_inv": 0.2, "hf_pyramid_slope": 0.1,
        "hf_pyramid_slope_inv": 0.1, "random_rough": 0.1, "wave_terrain": 0.1,
    }  # fmt: skip
    assert ALL_TERRAINS_CFG.num_cols == len(ALL_TERRAINS_CFG.sub_terrains) == 17
    assert {name: sub.proportion for name, sub in STAIRS_TERRAINS_CFG.sub_terrains.items()} == {
        "flat": 0.25, "easy_stairs": 0.35, "moderate_stairs": 0.25, "challenging_stairs": 0.15,
    }  # fmt: skip
