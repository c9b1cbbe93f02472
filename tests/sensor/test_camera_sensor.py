"""Tests of camera sensors: images, attachment and rendering times."""

from __future__ import annotations

import logging
import math

import pytest
import torch

from mjlab.sensor import CameraSensorCfg, ObjRef, RayCastSensorCfg
from mjlab.sensor.raycast_sensor import GridPatternCfg
from mjlab.sim.engine import EngineUnavailableError
from mjlab.utils.state import capture_state, restore_state

from .camera_scenes import BALL, ENGINES, ROOM, scene_with, sense

GEOM = 5
ALL = ("rgb", "depth", "segmentation")


def camera(name: str = "cam", camera_name: str | None = "room/down", **changes) -> CameraSensorCfg:
    values = {"width": 5, "height": 5, "data_types": ALL} | changes
    return CameraSensorCfg(name=name, camera_name=camera_name, **values)


def look(*sensors: CameraSensorCfg, **scene_options):
    """Return the model and the data of the sensors, in the first environment."""
    sim, scene = scene_with(*sensors, **scene_options)
    sense(sim)
    return (sim.mj_model, *(scene[sensor.name].data for sensor in sensors))


@pytest.fixture(scope="module", params=ENGINES)
def views(request):
    """Look through all cameras of the table at once."""
    names = ("down", "map", "up", "inside", "lens")
    sensors = [camera(name, f"room/{name}") for name in names]
    wide = camera("wide", "room/down", width=9, height=3, enabled_geom_groups=(0, 3))
    model, *data = look(*sensors, wide, engine=request.param)
    return model, dict(zip((*names, "wide"), data, strict=True))


# Images.


def test_depth_is_measured_along_the_optical_axis(views):
    _, data = views
    depth = data["down"].depth[0, ..., 0]
    assert depth[2, 2] == pytest.approx(1.5, abs=1e-5)
    # The corners show the floor, whose points are farther away along the rays.
    assert depth[0, 0] == pytest.approx(3.0, abs=1e-5)
    assert depth[4, 2] == pytest.approx(3.0, abs=1e-5)


def test_segmentation_names_geoms(views):
    model, data = views
    segmentation = data["down"].segmentation[0]
    assert segmentation[2, 2].tolist() == [model.geom("room/ball").id, GEOM]
    assert segmentation[0, 0].tolist() == [model.geom("room/floor").id, GEOM]


def test_color_is_that_of_the_geom_under_the_lights_that_shine(views):
    _, data = views
    # The headlight of a scene: 0.3 ambient and 0.6 diffuse. The floor is a sideways glance off.
    assert data["map"].rgb[0, 0, 0].tolist() == [229, 114, 0]
    assert data["map"].rgb[0, 2, 2].tolist() == [0, 114, 229]
    # Rays through the corners are at 48.5 degrees to the axis, along which the headlight shines.
    assert data["down"].rgb[0, 0, 0].tolist() == [229, 114, 0]


def test_where_there_is_nothing_images_are_empty(views):
    _, data = views
    up = data["up"]
    assert up.depth.eq(0.0).all()
    assert up.segmentation.eq(-1).all()
    assert up.rgb.eq(0).all()


def test_images_have_the_types_and_shapes_that_are_promised(views):
    _, data = views
    wide = data["wide"]
    assert (wide.rgb.shape, wide.rgb.dtype) == ((1, 3, 9, 3), torch.uint8)
    assert (wide.depth.shape, wide.depth.dtype) == ((1, 3, 9, 1), torch.float32)
    assert (wide.segmentation.shape, wide.segmentation.dtype) == ((1, 3, 9, 2), torch.int32)


def test_the_first_row_is_at_the_top_and_the_first_column_on_the_left(views):
    model, data = views
    # The post is ahead to the right: +x is right, and +y is up in a camera that looks down.
    ids = data["wide"].segmentation[0, ..., 0]
    seen = (ids == model.geom("room/post").id).nonzero()
    assert len(seen)
    assert (seen[:, 0] == 0).all()
    assert (seen[:, 1] > 4).all()


def test_each_sensor_sees_its_own_geom_groups_though_they_share_a_camera(views):
    model, data = views
    ids = data["wide"].segmentation[..., 0]
    assert not (ids == model.geom("room/ball").id).any()
    assert not (data["down"].segmentation[..., 0] == model.geom("room/post").id).any()


def test_what_is_fully_transparent_is_not_seen(views):
    model, data = views
    ids = data["wide"].segmentation[0, ..., 0]
    is_post = ids == model.geom("room/post").id
    assert data["wide"].rgb[0][is_post].eq(0).all(), "the post is black"
    assert is_post.any()
    # Its mirror image in the plane x = 0 has an alpha of 0.
    assert not (ids == model.geom("room/glass").id).any()
    assert (ids.flip(1)[is_post] == model.geom("room/floor").id).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_transparency_is_that_of_the_material(engine):
    xml = """<mujoco><asset><material name="clear" rgba="1 1 1 0"/></asset><worldbody>
      <geom name="near" size=".5" pos="0 0 2" material="clear"/><geom name="far" size=".5"/>
      <camera name="down" pos="0 0 4"/></worldbody></mujoco>"""
    eye = camera(data_types=("depth",))
    sim, scene = scene_with(eye, xml=xml, engine=engine, num_envs=3)
    sim.expand_model_fields(["geom_rgba", "mat_rgba"])
    sim.model.geom_rgba[1, sim.mj_model.geom("room/near").id] = 1.0
    sim.model.mat_rgba[2, :, 3] = 0.5
    sense(sim)
    depth = scene["cam"].data.depth[:, 2, 2, 0]
    assert depth.tolist() == pytest.approx([3.5, 1.5, 1.5], abs=1e-5)


def test_rays_of_an_orthographic_camera_are_parallel(views):
    model, data = views
    depth, ids = data["map"].depth[0, ..., 0], data["map"].segmentation[0, ..., 0]
    ball = ids == model.geom("room/ball").id
    # 4 m are 5 pixels, so that the ball of 1 m is under the middle one alone.
    assert ball.nonzero().tolist() == [[2, 2]]
    assert depth[~ball].allclose(torch.tensor(3.0))


def test_a_camera_in_a_geom_looks_through_it(views):
    model, data = views
    assert (data["inside"].segmentation[..., 0] == model.geom("room/floor").id).all()
    assert data["inside"].depth.allclose(torch.tensor(1.0))


def test_a_sensor_is_cropped_to_the_shape_of_the_image():
    # 2.14 mm of the 3.896 mm are used: a field of view of 58 deg both ways.
    fovy = 2 * math.degrees(math.atan(0.00214 / 2 / 0.00193))
    same = camera("same", None, pos=(0.0, 0.0, 3.0), fovy=fovy, width=32, height=32)
    lens = camera("lens", "room/lens", width=32, height=32)
    _, a, b = look(lens, same)
    assert a.depth.allclose(b.depth, atol=1e-5)
    assert a.segmentation.equal(b.segmentation)


def test_a_principal_point_shifts_the_image():
    shifted = camera("shifted", "room/lens", width=64, height=64)
    xml = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
      <geom name="ball" type="sphere" size=".1" pos="0 0 1"/>
      <camera name="lens" pos="0 0 2" resolution="64 64" sensorsize=".02 .02" focal=".01 .01"
        principal=".005 .0025"/></worldbody></mujoco>"""
    model, data = look(shifted, xml=xml)
    row, column = (data.segmentation[0, ..., 0] == model.geom("room/ball").id).nonzero(
        as_tuple=True
    )
    # MuJoCo shifts the frustum, by a quarter of the image to the right and by an eighth down.
    assert column.float().mean() == pytest.approx(31.5 - 16, abs=0.5)
    assert row.float().mean() == pytest.approx(31.5 - 8, abs=0.5)


# Attachment.


def test_a_camera_without_a_name_is_added_to_the_world_or_to_a_body():
    here = camera("here", None, pos=(0.0, 0.0, 3.0))
    there = camera("there", None, parent_body="ball/ball", pos=(0.0, 0.0, 1.0))
    sim, scene = scene_with(here, there, ball=BALL)
    model = sim.mj_model
    assert [model.camera(name).fovy.item() for name in ("here", "there")] == [45.0, 45.0]
    assert scene["here"].camera_name == "here"
    assert scene["there"].camera_idx == model.camera("there").id
    scene["ball"].write_root_link_pose_to_sim(torch.tensor([[0.0, 0.0, 4.0, 1.0, 0.0, 0.0, 0.0]]))
    sense(sim)
    # One metre above the middle of the ball, whose radius is 0.07.
    assert scene["there"].data.depth[0, 2, 2] == pytest.approx(0.93, abs=1e-5)


def test_a_field_of_view_takes_the_place_of_a_sensor():
    sim, scene = scene_with(camera("lens", "room/lens", fovy=30.0))
    index = scene["lens"].camera_idx
    assert sim.mj_model.cam_fovy[index] == pytest.approx(30.0)
    assert sim.mj_model.cam_sensorsize[index].tolist() == [0.0, 0.0]


def test_an_existing_camera_can_be_made_orthographic():
    model, data = look(camera(orthographic=True, fovy=4.0))
    assert data.depth[0, 0, 0] == pytest.approx(3.0)
    assert (data.segmentation[..., 0] == model.geom("room/ball").id).sum() == 1


def test_two_sensors_that_want_one_camera_otherwise_are_refused():
    with pytest.raises(ValueError, match=r"'a' and 'b'.*'room/down'.*fovy.* 30.0 and 40.0"):
        scene_with(camera("a", fovy=30.0), camera("b", fovy=40.0))
    with pytest.raises(ValueError, match="orthographic.* True and False"):
        scene_with(camera("a", orthographic=True), camera("b"))


@pytest.mark.parametrize("engine", ENGINES)
def test_a_ray_sensor_in_the_scene_leaves_the_groups_of_a_camera_alone(engine):
    rays = RayCastSensorCfg(
        name="rays",
        frame=ObjRef("geom", "ball", entity="ball"),
        pattern=GridPatternCfg(size=(0.0, 0.0)),
        include_geom_groups=(0, 1, 2, 3, 4, 5),
    )
    eye = camera(enabled_geom_groups=(0,))
    sim, scene = scene_with(eye, rays, engine=engine, ball=BALL)
    sense(sim)
    assert (scene["cam"].data.segmentation[..., 0] != sim.mj_model.geom("room/ball").id).all()


# Rendering times.


@pytest.mark.parametrize("engine", ENGINES)
def test_images_are_empty_before_and_change_with_sense_only(engine):
    eye = camera("eye", "room/down", width=7, height=7)
    sim, scene = scene_with(eye, engine=engine, ball=BALL)
    assert scene["eye"].data.depth.eq(0.0).all()
    assert scene["eye"].data.segmentation.eq(-1).all()
    scene["ball"].write_root_link_pose_to_sim(torch.tensor([[0.0, 0.0, 2.5, 1.0, 0.0, 0.0, 0.0]]))
    sim.forward()
    scene.update(0.02)
    assert scene["eye"].data.depth.eq(0.0).all()
    sim.sense()
    assert scene["eye"].data.depth[0, 3, 3] == pytest.approx(0.43, abs=1e-5)


def test_data_is_overwritten_unless_it_is_cloned():
    sensors = (camera("live"), camera("kept", clone_data=True))
    sim, scene = scene_with(*sensors, ball=BALL)
    pose = torch.tensor([[0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]])
    scene["ball"].write_root_link_pose_to_sim(pose)
    sense(sim)
    live, kept = scene["live"].data.depth, scene["kept"].data.depth
    before = kept.clone()
    assert scene["kept"].data.depth is kept, "it is cloned once, not at each reading"
    scene["ball"].write_root_link_pose_to_sim(pose + torch.tensor([[0, 0, 0.5, 0, 0, 0, 0]]))
    sense(sim)
    assert kept.equal(before)
    assert live.equal(scene["kept"].data.depth)
    assert not live.equal(before)


def test_images_can_be_rendered_under_inference_mode_and_then_without():
    sim, scene = scene_with(camera(), ball=BALL)
    with torch.inference_mode():
        sense(sim)
    first = scene["cam"].data.depth.clone()
    scene["ball"].write_root_link_pose_to_sim(torch.tensor([[0.0, 0, 2.5, 1, 0, 0, 0]]))
    sense(sim)
    assert not scene["cam"].data.depth.equal(first)
    scene["cam"].data.depth.zero_()


# The sensor context.


def test_the_context_gives_images_by_camera():
    small = camera("small", data_types=("depth",))
    large = camera("large", width=7, height=6, data_types=("rgb", "segmentation"))
    sim, scene = scene_with(small, large)
    sense(sim)
    context, index = scene.sensor_context, scene["small"].camera_idx
    context.unpack_rgb()
    assert context.has_cameras
    assert context.get_depth(index).data_ptr() == scene["small"].data.depth.data_ptr()
    assert context.get_rgb(index).shape == (1, 6, 7, 3)
    assert context.get_segmentation(index).shape == (1, 6, 7, 2)
    with pytest.raises(ValueError, match=r"'depth'.* 0 \(small\)"):
        context.get_depth(index + 1)


def test_the_render_context_is_that_of_warp():
    sim, scene = scene_with(camera("eye", "room/down", width=7, height=7), engine="warp", ball=BALL)
    with pytest.raises(RuntimeError, match="sense"):
        _ = scene.sensor_context.render_context
    sense(sim)
    assert scene.sensor_context.render_context.nrender == 1
    sim, scene = scene_with(camera())
    with pytest.raises(AttributeError, match="render_context.*native"):
        _ = scene.sensor_context.render_context


# Bad input.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": -1}, r"width: expected an integer >= 0, got -1"),
        ({"height": 3.5}, r"height.* 3.5"),
        ({"data_types": ("rgb", "normals")}, r"data_types.*'rgb'.*'normals'"),
        ({"data_types": "rgb"}, r"data_types.*\['rgb'.* 'r'\.$"),
    ],
)
def test_a_config_that_makes_no_sense_is_refused(changes, message):
    with pytest.raises(ValueError, match=message) as error:
        camera(**changes).build()
    assert str(error.value).startswith("Camera sensor 'cam'")


def test_a_camera_that_does_not_exist_is_refused_with_those_that_do():
    for changes in ({}, {"fovy": 30.0}):
        with pytest.raises(ValueError) as error:
            scene_with(camera(camera_name="room/dawn", **changes))
        text = str(error.value)
        assert "camera 'room/dawn'" in text
        assert all(repr(name) in text for name in ("room/down", "room/inside", "room/lens"))
        assert "did you mean 'room/down'" in text


def test_a_body_that_does_not_exist_and_a_name_that_is_taken_are_refused():
    with pytest.raises(ValueError, match="body 'ball' .*vailable: .*ball/ball"):
        scene_with(camera(camera_name=None, parent_body="ball"), ball=BALL)
    with pytest.raises(ValueError, match="camera 'room/down'.*camera_name='room/down'"):
        scene_with(camera("room/down", None))


@pytest.mark.parametrize(
    "changes",
    [
        {"enabled_geom_groups": (0, 1, 6)},
        {"parent_body": "ball/ball"},
        {"camera_name": None, "pos": (0.0, 0.0, 3.0), "fovy": -1.0},
        {"camera_name": None, "pos": (0.0, 0.0, 3.0), "fovy": 0.0},
    ],
)
@pytest.mark.parametrize("engine", ENGINES)
def test_odd_values_of_a_camera_are_accepted(changes, engine):
    sim, scene = scene_with(camera(**changes), ball=BALL, engine=engine)
    sense(sim)
    # The ball's top is 1.5 m below the camera.
    depth = scene["cam"].data.depth
    middle = depth[0, depth.shape[1] // 2, depth.shape[2] // 2]
    assert middle.item() == pytest.approx(1.5, abs=0.02)


@pytest.mark.parametrize("engine", ENGINES)
def test_images_may_have_no_pixels(engine):
    sim, scene = scene_with(camera(width=0), camera("eye"), engine=engine)
    sense(sim)
    assert scene["cam"].data.depth.shape == (1, 5, 0, 1)
    assert scene["eye"].data.depth.max() > 0.0


def test_a_camera_that_can_see_nothing_is_told_to_people(caplog):
    with caplog.at_level(logging.WARNING):
        _, data = look(camera(enabled_geom_groups=(5,)))
    assert "sees nothing" in caplog.text
    assert "[0, 1, 3]" in caplog.text
    assert data.segmentation.eq(-1).all()


CLOTH = """
<mujoco><worldbody>
  <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="3 0 1" dim="2" mass="1"
    radius=".01"><edge equality="true"/></flexcomp>
</worldbody></mujoco>
"""


def test_unsupported_images_fail_at_build():
    with pytest.raises(
        EngineUnavailableError, match="cameras of the native engine do not see flexes"
    ):
        scene_with(camera(), cloth=CLOTH)
    sim, _ = scene_with(cloth=CLOTH)
    with pytest.raises(EngineUnavailableError, match="--engine warp"):
        sim.render(())


def test_a_sky_is_seen_where_there_is_nothing():
    sky = camera("sky", "room/front", width=8, height=8)
    _, data = look(
        sky, xml=ROOM.replace('type="plane"', 'type="box"').replace("0 0 .01", "1 1 .01")
    )
    missed = data.segmentation[..., 0] == -1
    assert missed.any()
    assert (data.rgb[missed].sum(dim=-1) > 0).all()


# Run-time behavior.


@pytest.mark.parametrize("engine", ENGINES)
def test_diverged_envs_leave_images_of_others(engine):
    eyes = (
        camera("eye", "room/down", width=7, height=7),
        camera("rider", None, parent_body="ball/ball", width=7, height=7),
    )
    sim, scene = scene_with(*eyes, engine=engine, num_envs=3, ball=BALL)
    sense(sim)
    before = [scene[eye.name].data for eye in eyes]
    before = [(data.rgb.clone(), data.depth.clone()) for data in before]
    sim.data.qpos[1] = torch.nan
    sense(sim)
    for eye, (rgb, depth) in zip(eyes, before, strict=True):
        data = scene[eye.name].data
        assert data.rgb[[0, 2]].equal(rgb[[0, 2]])
        assert data.depth[[0, 2]].equal(depth[[0, 2]])
        assert not data.depth.isnan().any()


@pytest.mark.parametrize("engine", ENGINES)
def test_a_camera_that_has_diverged_sees_no_geom_but_the_sky(engine):
    """Textures and shadows have no place to be looked up or cast from there."""
    eye = camera("rider", None, parent_body="ball/ball", use_shadows=True)
    sim, scene = scene_with(eye, xml=ROOM, engine=engine, num_envs=3, ball=BALL)
    sense(sim)
    before = scene["rider"].data.rgb.clone()
    sim.data.qpos[1] = torch.nan
    sense(sim)
    data = scene["rider"].data
    assert data.rgb[[0, 2]].equal(before[[0, 2]])
    assert data.segmentation[1].eq(-1).all()
    assert data.depth[1].eq(0.0).all()


# Shadow rays start 0.1 mm above the surface.
@pytest.mark.parametrize("height", [-1.0, -0.9999])
def test_a_light_on_a_surface_casts_no_shadow_there(height):
    """MuJoCo raises for a ray without a direction."""
    xml = f"""<mujoco><worldbody><light type="point" pos="0 0 {height}"/><camera name="eye"/>
      <geom type="plane" size="0 0 1" pos="0 0 -1"/></worldbody></mujoco>"""
    eye = camera("eye", "room/eye", width=1, height=1, data_types=("rgb",), use_shadows=True)
    _, data = look(eye, xml=xml)
    assert (data.rgb > 0).all()


def test_an_environment_for_whose_rays_mujoco_raises_has_no_shadows():
    eye = camera("eye", "room/front", data_types=("rgb",), use_shadows=True, width=16, height=16)
    sim, scene = scene_with(eye, xml=ROOM, num_envs=3, ball=BALL)
    sense(sim)
    before = scene["eye"].data.rgb.clone()
    # A sun that shines nowhere, which shadow rays cannot point to.
    sim.data.light_xdir[1, sim.mj_model.light("room/sun").id] = 0.0
    sim.sense()
    assert scene["eye"].data.rgb[[0, 2]].equal(before[[0, 2]])
    assert not scene["eye"].data.rgb[1].equal(before[1])


def test_images_are_part_of_the_state_of_an_environment():
    """A reward of the next step sees the images of the step before, after a resume as well."""
    sim, scene = scene_with(camera(), ball=BALL)
    sense(sim)
    saved = capture_state(scene)
    image = scene["cam"].data.rgb.clone()
    scene["ball"].write_root_link_pose_to_sim(torch.tensor([[0.0, 0, 2.5, 1, 0, 0, 0]]))
    sense(sim)
    assert not scene["cam"].data.rgb.equal(image)
    restore_state(scene, saved)
    assert scene["cam"].data.rgb.equal(image)
    sim.sense()
    assert not scene["cam"].data.rgb.equal(image)
