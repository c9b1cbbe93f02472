"""Images of camera sensors in the browser viewer, without a browser."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mjlab.sensor import CameraSensorCfg
from mjlab.viewer.viser.camera_viewer import (
    ViserCameraViewer,
    depth_colors,
    vertical_angle,
)
from mjlab.viewer.viser.overlays import ViserCameraOverlays

from ...sensor.camera_scenes import BALL, scene_with, sense  # noqa: TID252

ALL = ("rgb", "depth", "segmentation")


def feeds_of(server, *sensors: CameraSensorCfg, num_envs: int = 2):
    sim, scene = scene_with(*sensors, num_envs=num_envs, ball=BALL)
    sense(sim)
    env = SimpleNamespace(sim=sim, scene=scene)
    redraws = []
    overlays = ViserCameraOverlays(
        server, env, sim.mj_model, request_redraw=lambda: redraws.append(1)
    )
    overlays.setup_controls()
    return sim, scene, overlays, redraws


def eye(name: str = "eye", camera: str = "room/down", **changes) -> CameraSensorCfg:
    values = {"width": 8, "height": 6, "data_types": ALL} | changes
    return CameraSensorCfg(name=name, camera_name=camera, **values)


def test_the_images_are_those_of_the_selected_environment(viser_server) -> None:
    sim, scene, feeds, _ = feeds_of(viser_server, eye())
    # In the second environment a ball is close to the camera.
    pose = torch.tensor([[0.0, 0.0, 0.5, 1, 0, 0, 0], [0.0, 0.0, 2.9, 1, 0, 0, 0]])
    scene["ball"].write_root_link_pose_to_sim(pose)
    sense(sim)
    handles = feeds.camera_viewers[0]._images
    shown = []
    for env in (0, 1):
        feeds.update(sim.data, env, np.zeros(3))
        assert handles["rgb"].image.shape == (22 * 6, 22 * 8, 3)
        rgb = scene["eye"].data.rgb[env].numpy()
        np.testing.assert_array_equal(handles["rgb"].image[::22, ::22], rgb)
        shown.append({kind: handle.image for kind, handle in handles.items()})
    for kind in ALL:
        assert (shown[0][kind] != shown[1][kind]).any(), kind


def test_the_slider_says_at_how_many_metres_depth_is_white(viser_server) -> None:
    sim, _, feeds, redraws = feeds_of(viser_server, eye(data_types=("depth",)))
    feed = feeds.camera_viewers[0]
    assert set(feed._images) == {"depth"}
    assert (feed._range.value, feed._range.min, feed._range.max) == (1.0, 0.1, 10.0)
    feeds.update(sim.data, 0, np.zeros(3))
    assert feed._images["depth"].image.min() == 255, "everything is farther away than 1 m"
    feed._range.value = 6.0
    feeds.update(sim.data, 0, np.zeros(3))
    # The floor is 3 m away.
    assert feed._images["depth"].image[0, 0].tolist() == [127, 127, 127]
    assert redraws


def test_the_frustum_stands_where_the_camera_is_and_can_be_hidden(viser_server) -> None:
    sim, _, feeds, _ = feeds_of(viser_server, eye(), eye("map", "room/map"))
    feed, other = feeds.camera_viewers
    feeds.update(sim.data, 0, np.array([1.0, 0.0, 0.0]))
    frustum = feed._frustum
    np.testing.assert_allclose(frustum.position, [1.0, 0.0, 3.0])
    # The frustum looks along its z axis, and the camera looks down.
    w, x, y, z = frustum.wxyz
    forward = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    np.testing.assert_allclose(forward, [0.0, 0.0, -1.0], atol=1e-6)
    assert frustum.fov == pytest.approx(math.radians(90.0))
    assert frustum.aspect == pytest.approx(8 / 6)
    feed._shows_frustum.value = False
    feeds.update(sim.data, 0, np.zeros(3))
    assert not frustum.visible
    assert other._frustum is None, "parallel rays have no frustum"


def test_the_field_of_view_of_a_sensor_is_that_of_the_part_that_is_used() -> None:
    sensor, focal = np.array([0.004, 0.002]), 0.001
    assert vertical_angle(45.0, np.zeros(2), focal, 1.0) == pytest.approx(math.radians(45.0))
    assert vertical_angle(45.0, sensor, focal, 1.0) == pytest.approx(2 * math.atan(1.0))
    assert vertical_angle(45.0, sensor, focal, 4.0) == pytest.approx(2 * math.atan(0.5))


def test_depth_grows_lighter_and_nothing_is_white() -> None:
    depth = np.array([[[0.0], [0.5], [1.0], [3.0]]])
    assert depth_colors(depth, 2.0)[0, :, 0].tolist() == [255, 63, 127, 255]


def test_a_viewer_of_one_camera_is_made_and_removed_by_itself(viser_server) -> None:
    sim, scene, feeds, _ = feeds_of(viser_server, eye())
    feeds.cleanup()
    viewer = ViserCameraViewer(viser_server, scene["eye"], sim.mj_model, min_display_size=30)
    viewer.update(sim.data)
    assert viewer._images["rgb"].image.shape == (5 * 6, 5 * 8, 3)
    np.testing.assert_allclose(viewer._frustum.position, [0.0, 0.0, 3.0])
    viewer.cleanup()
    assert not viser_server.gui._container_handle_from_uuid["root"]._children
    assert "/cameras/eye" not in viser_server.scene._handle_from_node_name
