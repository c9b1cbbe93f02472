"""Terrain presets: sub-terrains with tuned parameters, and sets of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from mjlab.terrains.heightfield_terrains import (
    HfDiscreteObstaclesTerrainCfg,
    HfPerlinNoiseTerrainCfg,
    HfPyramidSlopedTerrainCfg,
    HfRandomUniformTerrainCfg,
    HfWaveTerrainCfg,
)
from mjlab.terrains.primitive_terrains import (
    BoxFlatTerrainCfg,
    BoxInvertedPyramidStairsTerrainCfg,
    BoxNarrowBeamsTerrainCfg,
    BoxNestedRingsTerrainCfg,
    BoxOpenStairsTerrainCfg,
    BoxPyramidStairsTerrainCfg,
    BoxRandomGridTerrainCfg,
    BoxRandomSpreadTerrainCfg,
    BoxRandomStairsTerrainCfg,
    BoxSteppingStonesTerrainCfg,
    BoxTiltedGridTerrainCfg,
)
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainGeneratorCfg

_F = TypeVar("_F", bound=Callable[..., SubTerrainCfg])


ALL_TERRAIN_PRESETS: dict[str, Callable[..., SubTerrainCfg]] = {}
"""Presets by name: functions that take fields to override."""


def terrain_preset(fn: _F) -> _F:
    """Decorator: register `fn` in `ALL_TERRAIN_PRESETS` under its name.

    Raises:
        ValueError: duplicate name.
    """
    name = getattr(fn, "__name__", repr(fn))
    if name in ALL_TERRAIN_PRESETS:
        raise ValueError(f"Terrain preset {name!r} already exists; use another name.")
    ALL_TERRAIN_PRESETS[name] = fn
    return fn


def _override(overrides: dict[str, Any], **defaults: Any) -> dict[str, Any]:
    """Return a preset's parameters: `overrides` of the user over `defaults`."""
    return {**defaults, **overrides}


# Each preset's fields can be overridden: `pyramid_stairs(step_width=0.4, proportion=0.2)`.


@terrain_preset
def flat(**overrides: Any) -> BoxFlatTerrainCfg:
    """Flat ground."""
    return BoxFlatTerrainCfg(**overrides)


def _stairs(overrides: dict[str, Any]) -> dict[str, Any]:
    return _override(
        overrides,
        step_height_range=(0.0, 0.2),
        step_width=0.3,
        platform_width=3.0,
        border_width=1.0,
    )


@terrain_preset
def pyramid_stairs(**overrides: Any) -> BoxPyramidStairsTerrainCfg:
    """Stairs that rise to a platform."""
    return BoxPyramidStairsTerrainCfg(**_stairs(overrides))


@terrain_preset
def pyramid_stairs_inv(**overrides: Any) -> BoxInvertedPyramidStairsTerrainCfg:
    """Stairs that descend to a platform."""
    return BoxInvertedPyramidStairsTerrainCfg(**_stairs(overrides))


@terrain_preset
def hf_pyramid_slope(**overrides: Any) -> HfPyramidSlopedTerrainCfg:
    """Hill with a platform."""
    return HfPyramidSlopedTerrainCfg(
        **_override(overrides, slope_range=(0.0, 0.7), platform_width=2.0, border_width=0.25)
    )


@terrain_preset
def hf_pyramid_slope_inv(**overrides: Any) -> HfPyramidSlopedTerrainCfg:
    """Hollow with a platform."""
    return hf_pyramid_slope(**_override(overrides, inverted=True))


@terrain_preset
def random_rough(**overrides: Any) -> HfRandomUniformTerrainCfg:
    """Rough ground with random heights."""
    return HfRandomUniformTerrainCfg(
        **_override(overrides, noise_range=(0.02, 0.10), noise_step=0.02, border_width=0.25)
    )


@terrain_preset
def wave_terrain(**overrides: Any) -> HfWaveTerrainCfg:
    """Waves along x and y."""
    return HfWaveTerrainCfg(
        **_override(overrides, amplitude_range=(0.0, 0.2), num_waves=4, border_width=0.25)
    )


@terrain_preset
def discrete_obstacles(**overrides: Any) -> HfDiscreteObstaclesTerrainCfg:
    """Blocks and pits with straight edges."""
    return HfDiscreteObstaclesTerrainCfg(**_override(
        overrides,
        obstacle_width_range=(0.3, 1.0), obstacle_height_range=(0.05, 0.3), num_obstacles=40,
        border_width=0.25,
    ))  # fmt: skip


@terrain_preset
def perlin_noise(**overrides: Any) -> HfPerlinNoiseTerrainCfg:
    """Smooth hills and valleys."""
    return HfPerlinNoiseTerrainCfg(**_override(
        overrides,
        height_range=(0.0, 1.0), octaves=4, persistence=0.3, lacunarity=2.0, scale=10.0,
        horizontal_scale=0.1, border_width=0.5,
    ))  # fmt: skip


@terrain_preset
def box_random_grid(**overrides: Any) -> BoxRandomGridTerrainCfg:
    """Grid of columns with random heights."""
    return BoxRandomGridTerrainCfg(
        **_override(overrides, grid_width=0.4, grid_height_range=(0.0, 0.3), platform_width=1.0)
    )


@terrain_preset
def random_spread_boxes(**overrides: Any) -> BoxRandomSpreadTerrainCfg:
    """Boxes at random places on flat ground."""
    return BoxRandomSpreadTerrainCfg(**_override(
        overrides,
        num_boxes=80, box_width_range=(0.1, 1.0), box_length_range=(0.1, 2.0),
        box_height_range=(0.05, 0.3), platform_width=1.0, border_width=0.25,
    ))  # fmt: skip


@terrain_preset
def open_stairs(**overrides: Any) -> BoxOpenStairsTerrainCfg:
    """Stairs of slabs that rise to a platform."""
    return BoxOpenStairsTerrainCfg(**_override(
        overrides,
        step_height_range=(0.1, 0.2), step_width_range=(0.4, 0.8), platform_width=1.0,
        border_width=0.25, inverted=False,
    ))  # fmt: skip


@terrain_preset
def random_stairs(**overrides: Any) -> BoxRandomStairsTerrainCfg:
    """Stairs with random step heights that rise to a platform."""
    return BoxRandomStairsTerrainCfg(**_override(
        overrides,
        step_width=0.8, step_height_range=(0.1, 0.3), platform_width=1.0, border_width=0.25,
    ))  # fmt: skip


@terrain_preset
def stepping_stones(**overrides: Any) -> BoxSteppingStonesTerrainCfg:
    """Stepping stones over a pit."""
    return BoxSteppingStonesTerrainCfg(**_override(
        overrides,
        stone_size_range=(0.4, 0.8), stone_distance_range=(0.2, 0.5), stone_height=0.2,
        stone_height_variation=0.1, stone_size_variation=0.2, displacement_range=0.1,
        floor_depth=2.0, platform_width=1.0, border_width=0.25,
    ))  # fmt: skip


@terrain_preset
def narrow_beams(**overrides: Any) -> BoxNarrowBeamsTerrainCfg:
    """Beams over a pit."""
    return BoxNarrowBeamsTerrainCfg(**_override(
        overrides,
        num_beams=12, beam_width_range=(0.2, 0.8), beam_height=0.2, spacing=0.8,
        platform_width=1.0, border_width=0.25, floor_depth=2.0,
    ))  # fmt: skip


@terrain_preset
def nested_rings(**overrides: Any) -> BoxNestedRingsTerrainCfg:
    """Rings over a pit."""
    return BoxNestedRingsTerrainCfg(**_override(
        overrides,
        num_rings=8, ring_width_range=(0.3, 0.6), gap_range=(0.1, 0.4), height_range=(0.1, 0.4),
        platform_width=1.0, border_width=0.25, floor_depth=2.0,
    ))  # fmt: skip


@terrain_preset
def tilted_grid(**overrides: Any) -> BoxTiltedGridTerrainCfg:
    """Columns with tilted tops over a pit."""
    return BoxTiltedGridTerrainCfg(**_override(
        overrides,
        grid_width=1.0, tilt_range_deg=20.0, height_range=0.3, platform_width=1.0,
        border_width=0.25, floor_depth=2.0,
    ))  # fmt: skip


ROUGH_TERRAINS_CFG = TerrainGeneratorCfg(
    size=(8.0, 8.0),
    border_width=20.0,
    num_rows=10,
    num_cols=20,
    sub_terrains={
        "flat": flat(proportion=0.2),
        "pyramid_stairs": pyramid_stairs(proportion=0.2, step_height_range=(0.0, 0.1)),
        "pyramid_stairs_inv": pyramid_stairs_inv(proportion=0.2, step_height_range=(0.0, 0.1)),
        "hf_pyramid_slope": hf_pyramid_slope(proportion=0.1, slope_range=(0.0, 1.0)),
        "hf_pyramid_slope_inv": hf_pyramid_slope_inv(proportion=0.1, slope_range=(0.0, 1.0)),
        "random_rough": random_rough(proportion=0.1),
        "wave_terrain": wave_terrain(proportion=0.1),
    },
    add_lights=True,
)
"""Rough terrain for legged robots, used by the rough velocity tasks."""

STAIRS_TERRAINS_CFG = TerrainGeneratorCfg(
    curriculum=True,
    size=(8.0, 8.0),
    border_width=20.0,
    num_rows=10,
    num_cols=4,
    sub_terrains={
        "flat": flat(proportion=0.25),
        "easy_stairs": pyramid_stairs(
            proportion=0.35, step_height_range=(0.02, 0.05), step_width=0.4
        ),
        "moderate_stairs": pyramid_stairs(
            proportion=0.25,
            step_height_range=(0.05, 0.08),
            step_width=0.35,
            platform_width=2.5,
            border_width=0.8,
        ),
        "challenging_stairs": pyramid_stairs(
            proportion=0.15,
            step_height_range=(0.08, 0.10),
            step_width=0.30,
            platform_width=2.0,
            border_width=0.5,
        ),
    },
    add_lights=True,
)
"""Curriculum of four stair types."""

ALL_TERRAINS_CFG = TerrainGeneratorCfg(
    size=(8.0, 8.0),
    border_width=20.0,
    num_rows=10,
    num_cols=len(ALL_TERRAIN_PRESETS),
    sub_terrains={name: preset() for name, preset in ALL_TERRAIN_PRESETS.items()},
    add_lights=True,
)
"""All presets, with equal proportions."""
