"""Flat spots of height fields."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.terrains.terrain_generator import FlatPatchSamplingCfg
from mjlab.terrains.utils import find_flat_patches_from_heightfield as find

from .heightfields import Built, build, obstacles, perlin, rough, slope


def patch(**fields) -> FlatPatchSamplingCfg:
    return FlatPatchSamplingCfg(**fields)


def spread_around(built: Built, x: float, y: float, radius: float) -> float:
    """Difference of the heights of all vertices within the radius of a point."""
    xs, ys = built.vertices()
    near = (xs[None, :] - x) ** 2 + (ys[:, None] - y) ** 2 <= radius**2 + 1e-9
    return float(np.ptp(built.surface[near]))


@given(
    kind=st.sampled_from([obstacles, perlin, slope]),
    radius=st.sampled_from([0.0, 0.1, 0.25, 0.33, 0.5]),
    limit=st.sampled_from([0.0, 0.02, 0.05, 0.1]),
    size=st.sampled_from([(8.0, 8.0), (6.0, 4.0)]),
    seed=st.integers(0, 50),
)
@settings(max_examples=40)
def test_flat_patches_are_flat_and_on_the_ground(kind, radius, limit, size, seed):
    sampling = {"spots": patch(num_patches=8, patch_radius=radius, max_height_diff=limit)}
    built = build(kind(size=size, flat_patch_sampling=sampling), 0.7, seed)
    found = built.output.flat_patches["spots"]
    assert found.shape == (8, 3)
    if spread_around(built, *found[0, :2], radius) > limit + 1e-6:
        # No vertex qualifies.
        middle = built.surface[built.surface.shape[0] // 2, built.surface.shape[1] // 2]
        np.testing.assert_allclose(found, np.tile([*np.array(size) / 2, middle], (8, 1)), atol=1e-6)
        return
    for x, y, z in found:
        # The rays must not pass along the edge of the field.
        inside = np.clip((x, y), 1e-6, np.array(size) - 1e-6)
        assert built.height_at(*inside) == pytest.approx(z, abs=1e-5)
        assert radius - 1e-9 <= x <= size[0] - radius + 1e-9
        assert radius - 1e-9 <= y <= size[1] - radius + 1e-9
        assert spread_around(built, x, y, radius) <= limit + 1e-6


def test_the_search_is_that_of_the_definition():
    """Every vertex, against max minus min over the disc written out."""
    rng = np.random.default_rng(0)
    heights = rng.choice([0.0, 0.03], size=(24, 17), p=[0.93, 0.07])
    radius, limit = 3, 0.02
    expected = set()
    for row in range(radius, 24 - radius):
        for col in range(radius, 17 - radius):
            disc = [
                heights[row + i, col + j]
                for i in range(-radius, radius + 1)
                for j in range(-radius, radius + 1)
                if i * i + j * j <= radius * radius
            ]
            if max(disc) - min(disc) <= limit:
                expected.add((row, col))
    assert len(expected) > 5
    # With a size of n - 1 pixels, vertices are one pixel apart.
    cfg = patch(num_patches=len(expected), patch_radius=0.3, max_height_diff=limit)
    found = find(heights, 0.1, 0.0, cfg, rng, size=(1.6, 2.3))
    assert {(round(y / 0.1), round(x / 0.1)) for x, y, _ in found} == expected


def test_radius_zero_means_no_margin():
    """With the reference no vertex qualifies then."""
    heights = np.zeros((5, 4))
    found = find(
        heights, 0.1, 0.2, patch(num_patches=20, patch_radius=0.0), np.random.default_rng(0)
    )
    assert len(np.unique(found, axis=0)) == 20
    assert found[:, 0].min() == found[:, 1].min() == 0.0
    assert (found[:, 2] == 0.2).all()


def test_positions_follow_the_real_spacing_of_vertices():
    """The reference places them at multiples of a pixel, one pixel off at the far edge."""
    heights = np.ones((80, 80))
    heights[70, 75] = 0.0
    cfg = patch(num_patches=1, patch_radius=0.0, z_range=(-0.5, 0.5))
    (found,) = find(heights, 0.1, 0.0, cfg, np.random.default_rng(0))
    np.testing.assert_allclose(found, [75 * 8 / 79, 70 * 8 / 79, 0.0])


def test_patches_are_drawn_once_each_while_there_are_enough():
    heights = np.zeros((6, 6))
    few = patch(num_patches=36, patch_radius=0.0)
    many = patch(num_patches=50, patch_radius=0.0)
    for cfg in (few, many):
        found = find(heights, 0.1, 0.0, cfg, np.random.default_rng(0))
        assert len(found) == cfg.num_patches
        assert (len(np.unique(found, axis=0)) == 36) is (cfg is few)


def test_ranges_choose_where():
    cfg = patch(num_patches=30, patch_radius=0.2, x_range=(1.0, 2.0), y_range=(3.0, 3.5))
    found = build(slope(slope_range=(0.0, 0.0), flat_patch_sampling={"a": cfg})).output
    x, y, _ = found.flat_patches["a"].T
    assert 1.0 <= x.min() < x.max() <= 2.0
    assert 3.0 <= y.min() < y.max() <= 3.5


def test_a_height_range_chooses_the_top_of_a_hill():
    cfg = patch(num_patches=5, patch_radius=0.3, z_range=(1.0, 2.0))
    found = build(slope(flat_patch_sampling={"top": cfg})).output.flat_patches["top"]
    assert found[:, 2] == pytest.approx(1.445)


def test_without_a_flat_spot_all_patches_are_the_center():
    cfg = patch(num_patches=4, patch_radius=0.5, max_height_diff=0.001)
    built = build(rough(flat_patch_sampling={"none": cfg}))
    found = built.output.flat_patches["none"]
    height = built.surface[40, 40]
    np.testing.assert_allclose(found, np.tile([4.0, 4.0, height], (4, 1)), atol=1e-6)


def test_a_seed_gives_the_same_patches():
    cfg = obstacles(flat_patch_sampling={"a": patch(patch_radius=0.3)})
    first, again, other = (build(cfg, seed=s).output.flat_patches["a"] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    "fields",
    [
        {"patch_radius": 5.0},
        {"max_height_diff": -0.1},
        {"x_range": (2.0, 1.0)},
        {"z_range": (2.0, 1.0)},
        {"y_range": (7.8, 9.0)},
        {"x_range": (-4.0, 0.2)},
    ],
)
def test_patches_without_room_are_at_the_center(fields):
    built = build(rough(flat_patch_sampling={"goal": patch(**fields)}))
    found = built.output.flat_patches["goal"]
    assert (found[:, :2] == np.array([4.0, 4.0])).all()
