"""Terrain normals against known planes and a general eigenvalue solver."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.tasks.velocity.mdp.terrain_utils import fit_terrain_normal, terrain_normal_from_sensors

UP = [0.0, 0.0, 1.0]


def reference(points: torch.Tensor, valid: torch.Tensor) -> list[float]:
    """Return the normal of one set of points (P, 3), by the definition and LAPACK."""
    points = points[valid].double()
    if len(points) < 3:
        return UP
    offsets = points - points.mean(dim=0)
    (low, middle, high), vectors = torch.linalg.eigh(offsets.T @ offsets)
    eps = torch.finfo(torch.float32).eps
    if low / max(middle, eps) >= 0.1 or middle <= 1e-6 * max(high, eps):
        return UP
    normal = vectors[:, 0]
    return (-normal if normal[2] < 0 else normal).tolist()


@settings(max_examples=100, deadline=None)
@given(
    slope=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
    center=st.tuples(*[st.floats(-60.0, 60.0)] * 3),
    noise=st.floats(0.0, 0.05),
    seed=st.integers(0, 10**6),
)
def test_the_normal_is_the_direction_of_least_spread(slope, center, noise, seed):
    generator = torch.Generator().manual_seed(seed)
    xy = torch.rand(32, 2, generator=generator) * torch.tensor([1.6, 1.0])
    z = xy @ torch.tensor(slope) + noise * torch.randn(32, generator=generator)
    points = torch.cat((xy, z.unsqueeze(1)), dim=1) + torch.tensor(center)
    valid = torch.rand(32, generator=generator) < 0.8
    points[~valid] = 1000.0
    normal = fit_terrain_normal(points.unsqueeze(0), valid.unsqueeze(0))[0]
    assert normal.tolist() == pytest.approx(reference(points, valid), abs=2e-4)
    assert normal.norm().item() == pytest.approx(1.0, abs=1e-5)


@settings(max_examples=50, deadline=None)
@given(slope=st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)))
def test_points_of_a_plane_have_its_normal(slope):
    x, y = torch.meshgrid(torch.linspace(-1, 1, 5), torch.linspace(-1, 1, 4), indexing="ij")
    points = torch.stack((x, y, slope[0] * x + slope[1] * y), dim=-1).reshape(1, -1, 3)
    expected = torch.tensor([-slope[0], -slope[1], 1.0])
    normal = fit_terrain_normal(points, torch.ones(1, 20, dtype=torch.bool))[0]
    assert normal.tolist() == pytest.approx((expected / expected.norm()).tolist(), abs=1e-5)


SLOPE = torch.tensor([[0.0, 0, 0], [1, 0, 1], [0, 1, 0], [1, 1, 1.0]])


@pytest.mark.parametrize(
    ("points", "valid"),
    [
        (SLOPE, [True, True, False, False]),
        (SLOPE, [False] * 4),
        (torch.zeros(4, 3), [True] * 4),
        (torch.tensor([[0.0, 0, 0], [1, 0, 1], [2, 0, 2], [3, 0, 3]]), [True] * 4),
        (torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 1], [0, -1, 1.0]]), [True] * 4),
        (torch.tensor([[math.nan, 0, 0], [1, 0, 1], [0, 1, 0], [1, 1, 1.0]]), [True] * 4),
        (torch.tensor([[math.inf, 0, 0], [1, 0, 1], [0, 1, 0], [1, 1, 1.0]]), [True] * 4),
    ],
    ids=["two points", "none", "one place", "a line", "not flat", "nan", "inf"],
)
def test_points_without_a_plane_mean_level_ground(points, valid):
    normal = fit_terrain_normal(points.unsqueeze(0), torch.tensor([valid]))
    assert normal.tolist() == [UP]


def test_points_that_are_not_valid_may_hold_anything():
    points = torch.cat((SLOPE, torch.tensor([[math.nan, math.inf, 0.0]]))).unsqueeze(0)
    normal = fit_terrain_normal(points, torch.tensor([[True] * 4 + [False]]))
    assert normal[0].tolist() == pytest.approx([-math.sqrt(0.5), 0.0, math.sqrt(0.5)], abs=1e-6)


def sensor(points: torch.Tensor, distances: torch.Tensor | None = None) -> Any:
    if distances is None:
        distances = torch.ones(points.shape[:2])
    return SimpleNamespace(data=SimpleNamespace(hit_pos_w=points, distances=distances))


def env_of(**sensors: Any) -> Any:
    return SimpleNamespace(scene=sensors)


def test_a_sensor_with_many_rays_is_thinned_out_evenly():
    # All rays but those that are taken hit a wall; of 100, 4 are rays 0, 33, 66 and 99.
    points = torch.full((1, 100, 3), 50.0)
    points[0, [0, 33, 66, 99]] = SLOPE
    env = env_of(scan=sensor(points))
    normal = terrain_normal_from_sensors(env, ("scan",), max_points=4)
    assert normal[0].tolist() == pytest.approx([-math.sqrt(0.5), 0.0, math.sqrt(0.5)], abs=1e-6)


def test_several_sensors_are_fitted_together_without_their_misses():
    missed = torch.tensor([[1.0, 1.0, -1.0]])
    one = sensor(torch.stack((SLOPE[0], SLOPE[1], torch.tensor([9.0, 9, 9]))).unsqueeze(0), missed)
    env = env_of(one=one, other=sensor(SLOPE[2:].unsqueeze(0)))
    normal = terrain_normal_from_sensors(env, ("one", "other"))
    assert normal[0].tolist() == pytest.approx([-math.sqrt(0.5), 0.0, math.sqrt(0.5)], abs=1e-6)
