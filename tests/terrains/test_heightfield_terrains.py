"""Sub-terrains that are height fields: what MuJoCo compiles, against what the formulas say."""

from __future__ import annotations

import colorsys
import math

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.terrains.heightfield_terrains import color_by_height

from .heightfields import ALL, Built, build, obstacles, perlin, rough, slope, wave

DIFFICULTIES = (0.0, 0.5, 1.0)


def probe(built: Built, count: int = 60) -> list[tuple[int, int, float]]:
    """Return (row, col, height by a ray) at random vertices."""
    rng = np.random.default_rng(1)
    xs, ys = built.vertices()
    found = []
    for _ in range(count):
        # Rays at the outermost vertices might pass the field.
        row, col = rng.integers(1, len(ys) - 1), rng.integers(1, len(xs) - 1)
        found.append((row, col, built.height_at(xs[col], ys[row])))
    return found


# The surface is the formula.


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("size", [(8.0, 8.0), (8.0, 5.0)])
def test_a_slope_is_the_product_of_two_tents_cut_off_at_the_platform(inverted, size):
    built = build(slope(size=size, inverted=inverted), 0.6)
    width, length = int(size[0] / 0.1) - 4, int(size[1] / 0.1) - 4
    sign = -1 if inverted else 1
    peak = int(sign * 0.6 * 0.7 * width * 0.1 / 2 / 0.005)

    def raw(col: int, row: int) -> float:
        if not (0 <= col < width and 0 <= row < length):
            return 0.0
        a = [(half - abs(half - i)) / half for i, half in ((col, width // 2), (row, length // 2))]
        return peak * a[0] * a[1]

    cut = raw(width // 2 - 10, length // 2 - 10)
    for row, col, height in probe(built):
        value = raw(col - 2, row - 2)
        expected = 0.005 * round(max(value, cut) if inverted else min(value, cut))
        assert height == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("size", [(8.0, 8.0), (5.0, 8.0)])
def test_waves_are_a_cosine_along_x_and_a_sine_along_y(size):
    built = build(wave(size=size), 0.8)
    width, length = int(size[0] / 0.1) - 4, int(size[1] / 0.1) - 4
    amplitude = int(0.5 * 0.8 * 0.2 / 0.005)
    for row, col, height in probe(built):
        x, y = col - 2, row - 2
        value = 0.0
        if 0 <= x < width and 0 <= y < length:
            turn = 2 * math.pi * 4 / length
            value = amplitude * (math.cos(turn * x) + math.sin(turn * y))
        assert height == pytest.approx(0.005 * round(value), abs=1e-6)


def test_rough_ground_has_only_the_levels_asked_for_and_a_border_at_zero():
    built = build(rough(noise_range=(-0.04, 0.06), noise_step=0.02))
    steps = np.rint(built.surface / 0.02)
    np.testing.assert_allclose(built.surface, steps * 0.02, atol=1e-6)
    assert set(steps[2:-2, 2:-2].ravel()) == {-2, -1, 0, 1, 2, 3}
    border = np.ones(built.surface.shape, dtype=bool)
    border[2:-2, 2:-2] = False
    assert np.abs(built.surface[border]).max() < 1e-6


def test_rough_ground_draws_one_height_a_pixel_by_row_and_column():
    built = build(rough())
    drawn = np.random.default_rng(0).choice(np.arange(4, 24, 4), size=(76, 76))
    np.testing.assert_allclose(built.surface[2:-2, 2:-2], drawn * 0.005, atol=1e-6)


def test_coarse_rough_ground_is_smooth_between_draws():
    built = build(rough(size=(8.0, 6.0), border_width=0.0, downsampled_scale=2.0))
    drawn = np.random.default_rng(0).choice(np.arange(4, 24, 4), size=(3, 4)) * 0.005
    corners = built.surface[np.ix_([0, -1], [0, -1])]
    np.testing.assert_allclose(corners, drawn[np.ix_([0, -1], [0, -1])], atol=1e-6)
    steps = np.abs(np.diff(built.surface, axis=0)).max(), np.abs(np.diff(built.surface)).max()
    assert max(steps) < 0.03 < np.ptp(drawn), "no jumps from one height to the next"


def test_rough_ground_grows_with_difficulty_only_if_asked():
    assert np.ptp(build(rough(), 0.0).surface) == pytest.approx(0.1)
    scaled = [np.ptp(build(rough(scale_with_difficulty=True), d).surface) for d in DIFFICULTIES]
    np.testing.assert_allclose(scaled, [0.0, 0.05, 0.1], atol=1e-6)


def test_obstacles_have_full_and_half_heights_up_and_down():
    surface = build(obstacles(), 0.5).surface
    found = set(np.unique(np.rint(surface / 0.005)).astype(int))
    assert found == {-35, -18, 0, 17, 35}
    fixed = build(obstacles(obstacle_height_mode="fixed"), 0.5).surface
    assert set(np.unique(np.rint(fixed / 0.005)).astype(int)) == {0, 35}


@pytest.mark.parametrize("seed", range(5))
def test_the_platform_is_clear_of_obstacles(seed):
    built = build(obstacles(num_obstacles=200), seed=seed)
    assert np.abs(built.surface[35:45, 35:45]).max() < 1e-6
    assert built.output.origin[2] == 0.0


def test_an_offset_lifts_the_spawn_point_over_obstacles():
    assert build(obstacles(origin_z_offset=0.3)).output.origin[2] == pytest.approx(0.3)


def test_perlin_noise_is_smooth_with_a_flat_border():
    built = build(perlin(), 0.5)
    inner = built.surface[10:-10, 10:-10]
    assert (inner.min(), inner.max()) == (pytest.approx(0.0, abs=1e-6), pytest.approx(0.5))
    # Five hills along 140 pixels, and finer ones 0.3, 0.09 and 0.027 times as high.
    assert np.abs(np.diff(inner, axis=0)).max() < 0.06
    assert np.abs(np.diff(inner, axis=1)).max() < 0.06
    assert np.abs(built.surface[:10]).max() < 1e-6


def test_perlin_noise_is_that_of_the_reference():
    """At the center the reference measures 0.14 m with the preset at full height."""
    assert build(perlin(), 1.0).height_at(4.0, 4.0) == pytest.approx(0.1363, abs=1e-3)


def test_more_octaves_add_finer_detail():
    def roughness(octaves: int) -> float:
        surface = build(perlin(octaves=octaves, persistence=0.8)).surface[10:-10, 10:-10]
        return float(np.abs(np.diff(surface, 2)).mean())

    assert roughness(1) < roughness(2) < roughness(4)


# Measurements of the reference.


@pytest.mark.parametrize(
    ("cfg", "elevations", "tops"),
    [
        (slope(), (0.005, 0.72, 1.445), (0.0, 0.72, 1.445)),
        (slope(inverted=True), (0.005, 0.72, 1.445), (0.0, 0.0, 0.0)),
        (rough(), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1)),
        (wave(), (0.005, 0.2, 0.4), (0.0, 0.1, 0.2)),
        (obstacles(), (0.1, 0.35, 0.6), (0.05, 0.175, 0.3)),
        (perlin(), (0.001, 0.5, 1.0), (0.001, 0.5, 1.0)),
    ],
    ids=["slope", "slope_inv", "rough", "wave", "obstacles", "perlin"],
)
def test_the_check_values_of_the_presets(cfg, elevations, tops):
    for difficulty, elevation, top in zip(DIFFICULTIES, elevations, tops, strict=True):
        built = build(cfg, difficulty)
        assert built.model.hfield_size[0, 2] == pytest.approx(elevation, abs=1e-6)
        assert built.surface.max() == pytest.approx(top, abs=1e-6)
        # The surface of a wave and of a flat field is where the formula has it: around z = 0.
        assert built.surface[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_the_elevations_of_the_rough_tasks_slope():
    found = [
        build(slope(slope_range=(0.0, 1.0)), d).model.hfield_size[0, 2] for d in (1 / 3, 2 / 3, 1)
    ]
    assert found == pytest.approx([0.685, 1.375, 2.065])


# Spawn points.


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
@pytest.mark.parametrize("kind", ALL)
def test_spawn_points_are_on_the_ground(kind, difficulty):
    """The reference starts robots inside waves and rough ground, and 0.86 m above Perlin noise."""
    built = build(ALL[kind](), difficulty, seed=3)
    reach = {"slope": 1.0, "obstacles": 0.45}.get(kind, 1.0)
    x, y, z = built.output.origin
    assert (x, y) == (4.0, 4.0)
    angles, radii = np.meshgrid(np.linspace(0, 2 * math.pi, 16), np.linspace(0, 0.95 * reach, 8))
    heights = [
        built.height_at(x + r * math.cos(a), y + r * math.sin(a))
        for a, r in zip(angles.ravel(), radii.ravel(), strict=True)
    ]
    assert max(heights) <= z + 1e-6
    xs, ys = built.vertices()
    near = (xs[None, :] - x) ** 2 + (ys[:, None] - y) ** 2 <= reach**2
    assert built.surface[near].max() == pytest.approx(z, abs=1e-6)


def test_rough_ground_below_zero_leaves_the_border_at_zero():
    """The reference puts the lowest pixel at z = 0, so that the border stands out."""
    built = build(rough(noise_range=(-0.1, -0.02)))
    assert built.height_at(0.1, 4.0) == pytest.approx(0.0, abs=1e-6)
    assert built.surface.min() == pytest.approx(-0.1, abs=1e-6)
    bare = build(rough(noise_range=(-0.1, -0.02), border_width=0.0))
    assert bare.surface.max() == pytest.approx(-0.02, abs=1e-6)


# Shapes.


@pytest.mark.parametrize("kind", ALL)
def test_rows_come_from_the_y_size_and_columns_from_the_x_size(kind):
    """The reference swaps them, which stretches pixels where the sizes differ."""
    built = build(ALL[kind](size=(8.0, 4.0)))
    pixel = 0.05 if kind == "perlin" else 0.1
    assert built.surface.shape == (int(4.0 / pixel), int(8.0 / pixel))
    assert built.model.hfield_size[0, :2].tolist() == [4.0, 2.0]
    assert built.model.geom_pos[0, :2].tolist() == [4.0, 2.0]


def test_a_square_obstacle_is_square_on_a_field_that_is_not():
    cfg = obstacles(
        size=(12.0, 4.0), num_obstacles=1, obstacle_width_range=(1.0, 1.0), platform_width=0.0,
        obstacle_height_mode="fixed", square_obstacles=True,
    )  # fmt: skip
    built = build(cfg, seed=1)
    xs, ys = built.vertices()
    row, col = np.nonzero(built.surface > 0.1)
    extent = np.ptp(xs[col]), np.ptp(ys[row])
    assert extent[0] == pytest.approx(extent[1], rel=0.03)
    assert built.height_at(xs[col].mean(), ys[row].mean()) == pytest.approx(0.3)


@pytest.mark.parametrize("difficulty", DIFFICULTIES)
@pytest.mark.parametrize("kind", ALL)
def test_every_field_has_half_a_metre_of_ground_below(kind, difficulty):
    """A flat field of the reference is 5 mm thick, a flat wave 1.25 mm."""
    assert build(ALL[kind](), difficulty).model.hfield_size[0, 3] >= 0.5


def test_a_thicker_base_changes_no_surface():
    thin, thick = (build(rough(base_thickness_ratio=ratio)) for ratio in (1.0, 20.0))
    assert thick.model.hfield_size[0, 3] == pytest.approx(2.0)
    np.testing.assert_array_equal(thin.surface, thick.surface)


@given(
    kind=st.sampled_from(sorted(ALL)),
    size=st.tuples(st.floats(2.5, 12.0), st.floats(2.5, 12.0)),
    border=st.sampled_from([0.0, 0.25, 0.5]),
    difficulty=st.floats(0.0, 1.0),
    seed=st.integers(0, 100),
)
@settings(max_examples=60)
def test_every_field_of_every_size_is_sound(kind, size, border, difficulty, seed):
    fields = {"platform_width": 1.0} if kind in ("slope", "obstacles") else {}
    built = build(ALL[kind](size=size, border_width=border, **fields), difficulty, seed)
    assert np.isfinite(built.surface).all()
    assert (built.model.hfield_size[0] > 0.0).all()
    low, high = built.surface.min(), built.surface.max()
    x, y, z = built.output.origin
    assert low - 1e-6 <= z <= high + 1e-6
    assert built.height_at(x, y) <= z + 1e-6
    if border:
        edge = np.concatenate([built.surface[0], built.surface[-1], built.surface[:, 0]])
        assert np.abs(edge).max() < 1e-5


# Seeds and names.


@pytest.mark.parametrize("kind", ["rough", "obstacles", "perlin"])
def test_a_seed_gives_one_terrain(kind):
    first, again, other = (build(ALL[kind](), seed=seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.surface, again.surface)
    assert not np.array_equal(first.surface, other.surface)


def test_two_fields_in_one_spec_keep_apart():
    spec = mujoco.MjSpec()
    spec.worldbody.add_body(name="terrain")
    rng = np.random.default_rng(0)
    for cfg in (rough(), wave(), slope()):
        cfg.function(1.0, spec, rng)
    model = spec.compile()
    assert (model.nhfield, model.nmat, model.ntex) == (3, 3, 3)
    assert sorted(model.geom_matid.tolist()) == [0, 1, 2]
    assert sorted(model.geom_dataid.tolist()) == [0, 1, 2]


# Colors.


def test_colors_follow_height_on_one_scale():
    """Green at z = 0, red above, blue below; rows of the texture go down while y goes up."""
    heights = np.tile(np.linspace(-0.9, 0.9, 50)[:, None], (1, 30))
    spec = mujoco.MjSpec()
    name = color_by_height(spec, heights, "hills", heights, texture_size=64)
    assert name == "hills"
    spec.worldbody.add_geom(size=(1.0, 0.0, 0.0), material=name)
    model = spec.compile()
    pixels = model.tex_data.reshape(64, 64, 3)
    for row in (0, 20, 40, 63):
        height = np.interp(63 - row, [0, 63], [-0.9, 0.9])
        s = max(-1.0, min(height / 0.75, 1.0))
        level = 0.45 + 0.25 * abs(s)
        expected = [int(255 * part) for part in colorsys.hsv_to_rgb(0.33 * (1 - s), level, level)]
        np.testing.assert_allclose(pixels[row, 10], expected, atol=1)


# Invalid configs.


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        (rough(noise_step=0.0), r"noise_step: expected .*got 0.0"),
        (rough(noise_step=0.004), "noise_step: .*vertical_scale = 0.005.*got 0.004"),
        (rough(horizontal_scale=1e-7), "Pixels of 1e-07 m: .*larger pixels"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_what_cannot_be_built_is_refused_by_name(cfg, message):
    with pytest.raises(ValueError, match=message):
        build(cfg)


@pytest.mark.parametrize(
    ("cfg", "same"),
    [
        (rough(border_width=-0.2), rough(border_width=0.0)),
        (obstacles(obstacle_width_range=(1.0, 0.3)), obstacles(obstacle_width_range=(0.3, 1.0))),
        (obstacles(num_obstacles=-1), obstacles(num_obstacles=0)),
        (obstacles(obstacle_height_mode="tall"), obstacles(obstacle_height_mode="fixed")),
        (perlin(octaves=0), perlin(scale=0.0)),
    ],
)
def test_odd_values_have_an_equal_field(cfg, same):
    np.testing.assert_array_equal(build(cfg).surface, build(same).surface)


@pytest.mark.parametrize(
    "cfg",
    [
        wave(amplitude_range=(0.2, 0.1)),
        wave(amplitude_range=(-0.2, 0.1)),
        wave(num_waves=39),
        slope(slope_range=(0.5, 0.1)),
        slope(platform_width=7.6),
        slope(platform_width=-1.0),
        obstacles(platform_width=9.0),
        obstacles(obstacle_width_range=(-0.1, 0.3)),
        obstacles(obstacle_height_range=(0.3, -0.1)),
        perlin(scale=300.0),
        perlin(lacunarity=-2.0),
        perlin(persistence=-0.1),
        perlin(height_range=(1.0, 0.5)),
    ],
)
def test_values_of_other_releases_are_accepted(cfg):
    surface = build(cfg).surface
    assert np.isfinite(surface).all()
    assert np.ptp(surface) < 3.0


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("border", [4.0, 4.5, 20.0])
def test_fields_that_are_all_border_are_flat(kind, border):
    for size in ((8.0, 8.0), (8.1, 8.1), (8.0, 12.0)):
        built = build(ALL[kind](size=size, border_width=border))
        assert not built.surface.any()
        assert built.height_at(4.05, 4.05) == pytest.approx(0.0, abs=1e-6)


def test_ranges_may_fall_with_the_difficulty():
    falling = slope(slope_range=(0.5, 0.1))
    rising = slope(slope_range=(0.1, 0.5))
    for difficulty in (0.0, 0.3, 1.0):
        np.testing.assert_allclose(
            build(falling, difficulty=difficulty).surface,
            build(rising, difficulty=1.0 - difficulty).surface,
            # Heights are rounded to steps of 0.005 m.
            atol=0.0051,
        )
