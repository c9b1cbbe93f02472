"""Pinhole cameras: pixels and depths to points, and back."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.utils.lab_api.math import (
    orthogonalize_perspective_depth,
    project_points,
    unproject_depth,
)

K = torch.tensor([[200.0, 3.0, 64.0], [0.0, 210.0, 48.0], [0.0, 0.0, 1.0]])


@given(height=st.integers(1, 4), width=st.integers(2, 5), batch=st.integers(1, 3))
@settings(deadline=None, max_examples=20)
def test_projecting_undoes_unprojecting(height, width, batch):
    depth = 0.5 + torch.rand(batch, height, width)
    pixels = project_points(unproject_depth(depth, K), K)
    u, v = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="ij")
    expected = torch.stack((u.flatten(), v.flatten()), dim=-1).float()
    torch.testing.assert_close(pixels[..., :2], expected.expand(batch, -1, 2), atol=2e-4, rtol=1e-5)
    torch.testing.assert_close(pixels[..., 2], depth.transpose(1, 2).flatten(1))


def test_a_distance_is_the_norm_of_its_point():
    distance = 0.5 + torch.rand(2, 3, 4)
    points = unproject_depth(distance, K, is_ortho=False)
    torch.testing.assert_close(points.norm(dim=-1), distance.transpose(1, 2).flatten(1))
    depth = orthogonalize_perspective_depth(distance, K)
    torch.testing.assert_close(unproject_depth(depth, K), points)


@pytest.mark.parametrize(
    ("depth", "intrinsics", "points", "image"),
    [
        ((2, 3), (3, 3), (6, 3), (2, 3)),
        ((2, 3, 1), (3, 3), (6, 3), (2, 3, 1)),
        ((5, 2, 3), (3, 3), (5, 6, 3), (5, 2, 3)),
        ((5, 2, 3, 1), (3, 3), (5, 6, 3), (5, 2, 3, 1)),
        ((5, 2, 3, 1), (5, 3, 3), (5, 6, 3), (5, 2, 3, 1)),
        ((2, 3), (5, 3, 3), (5, 6, 3), (5, 2, 3)),
    ],
)
def test_shapes_of_images(depth, intrinsics, points, image):
    k = K.expand(intrinsics)
    assert unproject_depth(torch.ones(depth), k).shape == points
    assert unproject_depth(torch.ones(depth), k, is_ortho=False).shape == points
    assert orthogonalize_perspective_depth(torch.ones(depth), k).shape == image


@pytest.mark.parametrize(
    ("points", "intrinsics", "batch"),
    [
        ((4, 3), (3, 3), 1),
        ((2, 4, 3), (3, 3), 2),
        ((4, 3), (2, 3, 3), 2),
        ((2, 4, 3), (2, 3, 3), 2),
    ],
)
def test_shapes_of_points(points, intrinsics, batch):
    assert project_points(torch.ones(points), K.expand(intrinsics)).shape == (batch, 4, 3)


def test_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\[3\]"):
        project_points(torch.ones(3), K)
    for shape in ((3,), (1, 2, 3, 2)):
        with pytest.raises(ValueError, match="depth"):
            unproject_depth(torch.ones(shape), K)
