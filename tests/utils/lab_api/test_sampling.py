"""Random numbers, points and orientations."""

from __future__ import annotations

import math

import pytest
import torch

from mjlab.utils.lab_api import math as m

N = 20_000


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def assert_about(actual: torch.Tensor, expected, atol: float = 0.03) -> None:
    torch.testing.assert_close(actual, torch.as_tensor(expected), atol=atol, rtol=0)


def test_uniform_numbers_with_scalar_and_tensor_bounds():
    x = m.sample_uniform(-1.0, 3.0, (N, 2), "cpu")
    assert x.shape == (N, 2)
    assert x.min() >= -1
    assert x.max() < 3
    assert_about(x.mean(0), [1.0, 1.0])
    low, high = torch.tensor([0.0, 10.0]), torch.tensor([1.0, 12.0])
    assert_about(m.sample_uniform(low, high, (N, 2), "cpu").mean(0), [0.5, 11.0])
    assert m.sample_uniform(2.0, 2.0, 5, "cpu").tolist() == [2.0] * 5


def test_uniform_numbers_are_the_stated_function_of_the_generator():
    x = m.sample_uniform(-1.0, 3.0, 4, "cpu")
    torch.manual_seed(0)
    assert torch.equal(x, torch.rand(4) * 4.0 - 1.0)


def test_log_uniform_numbers():
    x = m.sample_log_uniform(0.01, 100.0, N, "cpu")
    assert x.min() >= 0.0099
    assert x.max() <= 100.1
    assert_about((x < 1).float().mean(), 0.5)
    y = m.sample_log_uniform(torch.tensor([1.0, 10.0]), torch.tensor([2.0, 20.0]), (N, 2), "cpu")
    assert_about(y.log().mean(0), torch.tensor([1.0, 10.0]).log() + 0.5 * math.log(2))


@pytest.mark.parametrize("mean", [1, 1.0])
def test_gaussian_numbers_of_a_number_take_the_size(mean):
    """The defect: a mean that is an int failed."""
    x = m.sample_gaussian(mean, 0.5, (N, 2), "cpu")
    assert x.shape == (N, 2)
    assert_about(x.mean(0), [1.0, 1.0])
    assert_about(x.std(0), [0.5, 0.5])


def test_gaussian_numbers_of_a_tensor_take_its_shape():
    mean = torch.tensor([0.0, 5.0]).expand(N, 2)
    x = m.sample_gaussian(mean, torch.tensor([1.0, 2.0]), 3, "cpu")
    assert x.shape == (N, 2)
    assert_about(x.mean(0), [0.0, 5.0], atol=0.05)
    assert_about(x.std(0), [1.0, 2.0], atol=0.05)


@pytest.mark.parametrize("mean", [1.0, torch.zeros(4)])
def test_gaussian_numbers_are_drawn_on_the_device_asked_for(monkeypatch, mean):
    """The defect: a float mean drew on the CPU, whatever the device."""
    devices = []
    draw = torch.randn

    def record(*args, device, **kwargs):
        devices.append(device)
        return draw(*args, **kwargs)

    monkeypatch.setattr(torch, "randn", record)
    monkeypatch.setattr(torch, "normal", None)
    m.sample_gaussian(mean, 0.5, 4, "cuda:1")
    assert devices == ["cuda:1"]


def test_triangular_numbers():
    x = m.sample_triangle(1.0, 3.0, N, "cpu")
    assert x.min() >= 1
    assert x.max() <= 3
    assert_about(x.std(), 2 / math.sqrt(24))
    assert_about(((x - 2).abs() < 0.5).float().mean(), 0.75)


def test_points_on_a_cylinder():
    points = m.sample_cylinder(2.0, (-1.0, 3.0), (N, 2), "cpu")
    assert points.shape == (N, 2, 3)
    torch.testing.assert_close(points[..., :2].norm(dim=-1), torch.full((N, 2), 2.0))
    assert_about(points.mean(dim=(0, 1)), [0.0, 0.0, 1.0], atol=0.05)


def test_orientations():
    quat = m.random_orientation(N, "cpu")
    torch.testing.assert_close(quat.norm(dim=-1), torch.ones(N))
    # Uniform over rotations: a vector ends uniformly on the sphere.
    turned = m.quat_apply(quat, torch.tensor([0.0, 0.0, 1.0]).expand(N, 3))
    assert_about(turned.mean(0), [0.0] * 3)
    assert_about(turned.square().mean(0), [1 / 3] * 3)
    yaw = m.random_yaw_orientation(N, "cpu")
    assert (yaw[:, 1:3] == 0).all()
    assert_about(m.quat_apply(yaw, torch.tensor([1.0, 0.0, 0.0]).expand(N, 3)).mean(0), [0.0] * 3)
    assert m.default_orientation(2, "cpu").tolist() == [[1, 0, 0, 0]] * 2


def test_random_transformations():
    pose = m.generate_random_transformation_matrix(pos_boundary=0.5)
    assert pose.shape == (4, 4)
    torch.testing.assert_close(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3), atol=1e-5, rtol=0)
    shifts = torch.stack([m.generate_random_translation(0.5) for _ in range(200)])
    assert shifts.abs().max() <= 0.5
    assert shifts.min() < 0 < shifts.max()
    small = m.quat_from_matrix(m.generate_random_rotation(rot_boundary=0.01))
    assert m.axis_angle_from_quat(small).norm() < 0.02


def test_each_column_is_drawn_from_its_own_range():
    ranges = [(0.0, 1.0), (5.0, 5.0), (-3.0, -2.0)]
    drawn = m.sample_ranges(ranges, (50, 4), "cpu")
    assert drawn.shape == (50, 4, 3)
    for column, (low, high) in zip(drawn.flatten(0, 1).T, ranges, strict=True):
        assert low <= column.min()
        assert column.max() <= high
    assert m.sample_ranges([(2.0, 2.0)], 3, "cpu").tolist() == [[2.0], [2.0], [2.0]]
