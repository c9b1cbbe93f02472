"""Tests of ray origins and directions, pattern by pattern."""

from __future__ import annotations

import math

import mujoco
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mjlab.sensor import GridPatternCfg, PinholeCameraPatternCfg, RingPatternCfg

CPU = "cpu"
CAMERAS = """
<mujoco><worldbody>
  <camera name="eye" fovy="60" resolution="8 4"/>
  <camera name="lens" resolution="4 2" sensorsize=".02 .01" focal=".01 .02" principal=".002 .001"/>
</worldbody></mujoco>
"""


def test_the_height_scan_of_the_reference_has_17_by_11_rays_with_x_fastest():
    offsets, directions = GridPatternCfg(size=(1.6, 1.0)).generate_rays(None, CPU)
    assert offsets.shape == directions.shape == (187, 3)
    grid = offsets.unflatten(0, (11, 17))
    torch.testing.assert_close(grid[0, :, 0], torch.linspace(-0.8, 0.8, 17))
    torch.testing.assert_close(grid[:, 0, 1], torch.linspace(-0.5, 0.5, 11))
    assert (grid[:, :, 0] == grid[:1, :, 0]).all()
    assert (grid[:, :, 1] == grid[:, :1, 1]).all()
    assert (directions == torch.tensor([0.0, 0.0, -1.0])).all()


@given(
    columns=st.integers(0, 12),
    rows=st.integers(0, 12),
    step=st.sampled_from([0.05, 0.1, 0.13, 0.7]),
)
def test_grids_of_whole_steps_are_centered(columns, rows, step):
    cfg = GridPatternCfg(size=(columns * step, rows * step), resolution=step)
    offsets, _ = cfg.generate_rays(None, CPU)
    assert len(offsets) == (columns + 1) * (rows + 1)
    torch.testing.assert_close(offsets.mean(dim=0), torch.zeros(3), atol=1e-6, rtol=0)
    half = torch.tensor([columns * step / 2, rows * step / 2])
    torch.testing.assert_close(offsets[0, :2], -half, atol=1e-6, rtol=0)
    torch.testing.assert_close(offsets[-1, :2], half, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        (0.25, [-0.125, -0.025, 0.075]),
        (0.24, [-0.12, -0.02, 0.08]),
        (0.05, [-0.025]),
        (0.06, [-0.03, 0.07]),
        (0.0, [0.0]),
    ],
)
def test_grids_of_broken_steps_start_low(size, expected):
    offsets, _ = GridPatternCfg(size=(size, 0.0), resolution=0.1).generate_rays(None, CPU)
    torch.testing.assert_close(offsets[:, 0], torch.tensor(expected), atol=1e-6, rtol=0)


@given(
    rings=st.lists(st.tuples(st.floats(0.0, 2.0), st.integers(1, 9)), max_size=4),
    center=st.booleans(),
)
def test_rings_come_one_after_the_other_each_counter_clockwise_from_x(rings, center):
    if not rings and not center:
        return
    cfg = RingPatternCfg(tuple(RingPatternCfg.Ring(r, n) for r, n in rings), include_center=center)
    offsets, directions = cfg.generate_rays(None, CPU)
    expected = [[0.0, 0.0, 0.0]] if center else []
    for radius, count in rings:
        angles = [2 * math.pi * k / count for k in range(count)]
        expected += [[radius * math.cos(a), radius * math.sin(a), 0.0] for a in angles]
    torch.testing.assert_close(offsets, torch.tensor(expected), atol=1e-6, rtol=0)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(len(expected)))


def test_a_single_ring_has_a_center_unless_it_is_left_out():
    assert len(RingPatternCfg.single_ring(0.2, 4).generate_rays(None, CPU)[0]) == 5
    alone = RingPatternCfg.single_ring(0.2, 4, include_center=False)
    assert len(alone.generate_rays(None, CPU)[0]) == 4


@pytest.mark.parametrize("pattern", [GridPatternCfg, lambda **kw: RingPatternCfg((), **kw)])
def test_directions_are_normalized(pattern):
    _, directions = pattern(direction=(0.0, 3.0, -4.0)).generate_rays(None, CPU)
    torch.testing.assert_close(directions[0], torch.tensor([0.0, 0.6, -0.8]))


def test_pinhole_rays_go_through_pixel_centers_from_the_top_left():
    cfg = PinholeCameraPatternCfg(width=4, height=2, fovy=90.0)
    offsets, directions = cfg.generate_rays(None, CPU)
    assert (offsets == 0.0).all()
    plane = (directions / -directions[:, 2:]).unflatten(0, (2, 4))
    # At distance 1 the image is 2 high and 4 wide; camera +y is up and row 0 is the top.
    torch.testing.assert_close(plane[0, :, 0], torch.tensor([-1.5, -0.5, 0.5, 1.5]))
    torch.testing.assert_close(plane[:, 0, 1], torch.tensor([0.5, -0.5]))
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(8))


def test_a_mujoco_camera_gives_resolution_and_field_of_view():
    model = mujoco.MjModel.from_xml_string(CAMERAS)
    taken = PinholeCameraPatternCfg.from_mujoco_camera("eye").generate_rays(model, CPU)[1]
    given_ = PinholeCameraPatternCfg(width=8, height=4, fovy=60.0).generate_rays(None, CPU)[1]
    torch.testing.assert_close(taken, given_)


def test_a_mujoco_camera_with_a_focal_length_sees_what_its_sensor_covers():
    model = mujoco.MjModel.from_xml_string(CAMERAS)
    rays = PinholeCameraPatternCfg.from_mujoco_camera("lens").generate_rays(model, CPU)[1]
    plane = (rays / -rays[:, 2:]).unflatten(0, (2, 4))
    # Horizontally sensor / focal length = 2, vertically 0.5; the principal point moves the image.
    edges = torch.tensor([-0.75, -0.25, 0.25, 0.75]) + 0.002 / 0.01
    torch.testing.assert_close(plane[0, :, 0], edges)
    rows = torch.tensor([0.125, -0.125]) - 0.001 / 0.02
    torch.testing.assert_close(plane[:, 0, 1], rows)


def test_an_intrinsic_matrix_gives_the_vertical_field_of_view():
    matrix = [100.0, 0, 32, 0, 24.0, 24, 0, 0, 1]
    cfg = PinholeCameraPatternCfg.from_intrinsic_matrix(matrix, width=64, height=48)
    assert (cfg.width, cfg.height) == (64, 48)
    assert cfg.fovy == pytest.approx(90.0)


@pytest.mark.parametrize("resolution", [0.0, -0.1, math.nan])
def test_resolution_is_positive(resolution):
    with pytest.raises(ValueError, match="resolution: expected"):
        GridPatternCfg(resolution=resolution).generate_rays(None, CPU)


def test_an_unknown_camera_lists_the_known():
    pattern = PinholeCameraPatternCfg.from_mujoco_camera("eyes")
    with pytest.raises(ValueError, match="camera 'eyes'.*'eye'"):
        pattern.generate_rays(mujoco.MjModel.from_xml_string(CAMERAS), CPU)


def test_rings_without_samples_have_no_rays():
    rings = (
        RingPatternCfg.Ring(0.1, 0),
        RingPatternCfg.Ring(0.2, -1),
        RingPatternCfg.Ring(-0.1, 2),
    )
    offsets, _ = RingPatternCfg(rings).generate_rays(None, CPU)
    expected = torch.tensor([[0.0, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    torch.testing.assert_close(offsets, expected)
    assert PinholeCameraPatternCfg(width=0).generate_rays(None, CPU)[0].shape == (0, 3)


def test_field_of_view_of_an_intrinsic_matrix():
    camera = PinholeCameraPatternCfg.from_intrinsic_matrix([1.0, 0, 0, 0, -1.0, 0, 0, 0, 1.0], 2, 2)
    assert camera.fovy == pytest.approx(-90.0)
