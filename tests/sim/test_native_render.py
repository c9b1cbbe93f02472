"""Native renderer: images do not depend on tiles, slots or the split of environments."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.sim import Simulation, SimulationCfg
from mjlab.sim.engine import CameraView
from mjlab.sim.native import render as native_render

SHAPES = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
ALL = ("rgb", "depth", "segmentation")


def random_world(seed: int) -> mujoco.MjModel:
    """Return a world of shapes scattered around a camera that sees some of them."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.add_mesh(
        name="wedge",
        uservert=[0, 0, 0.3, 0.3, 0, -0.1, -0.2, 0.2, -0.1, -0.1, -0.3, -0.2],
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, -1])
    for shape in rng.choice(SHAPES, size=12):
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}")
        direction = rng.normal(size=3)
        # Far enough that no shape contains the camera.
        pos = direction / np.linalg.norm(direction) * rng.uniform(1.2, 3.0)
        geom = spec.worldbody.add_geom(type=kind, pos=pos, quat=rng.normal(size=4))
        geom.size = rng.uniform(0.1, 0.5, size=3)
        if shape == "mesh":
            geom.meshname = "wedge"
    sensor = {"sensor_size": [0.02, 0.01], "focal_length": [0.01, 0.02]} if seed % 2 else {}
    camera = spec.worldbody.add_camera(name="eye", quat=rng.normal(size=4), fovy=70)
    camera.resolution = [4, 4]
    for name, value in sensor.items():
        setattr(camera, name, value)
    return spec.compile()


def cast_pixel_by_pixel(model: mujoco.MjModel, width: int, height: int):
    """Return depths and geom ids, (height, width), from one `mj_ray` per pixel."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    half_height = np.tan(np.radians(model.cam_fovy[0]) / 2)
    half_width = half_height * width / height
    if model.cam_sensorsize[0, 1]:
        (fx, fy, _, _), (w, h) = model.cam_intrinsic[0], model.cam_sensorsize[0]
        w, h = min(w, h * width / height), min(h, w * height / width)
        half_width, half_height = w / 2 / fx, h / 2 / fy
    depth, geoms = np.zeros((height, width)), np.full((height, width), -1)
    met = np.zeros(1, dtype=np.int32)
    for row in range(height):
        for column in range(width):
            x = (2 * (column + 0.5) / width - 1) * half_width
            y = (1 - 2 * (row + 0.5) / height) * half_height
            ray = data.cam_xmat[0].reshape(3, 3) @ np.array([x, y, -1.0])
            # A ray of this length measures along the optical axis.
            distance = mujoco.mj_ray(model, data, data.cam_xpos[0], ray, None, 1, -1, met)
            if distance >= 0 and distance < model.vis.map.zfar * model.stat.extent:
                depth[row, column], geoms[row, column] = distance, met[0]
    return depth, geoms


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), width=st.integers(1, 40), height=st.integers(1, 25))
def test_an_image_is_what_single_rays_meet(seed, width, height):
    model = random_world(seed)
    sim = Simulation(1, SimulationCfg(engine="native"), model=model, device="cpu")
    sim.forward()
    (images,) = sim.render((CameraView(0, width, height, ALL, (0,)),))
    depth, geoms = cast_pixel_by_pixel(model, width, height)
    same = images.segmentation[0, ..., 0].numpy() == geoms
    assert same.sum() >= same.size - 2, "but for single rays that graze an edge"
    rendered = images.depth[0, ..., 0].numpy()
    np.testing.assert_allclose(rendered[same], depth[same], rtol=1e-4, atol=1e-4)


ARM = """
<mujoco>
  <asset><texture name="t" type="2d" builtin="checker" rgb1="1 1 1" rgb2="0 0 0" width="64"
    height="64"/><material name="m" texture="t" texrepeat="5 5"/></asset>
  <worldbody>
    <light pos="0 0 3" type="directional"/>
    <geom type="plane" size="0 0 1" material="m"/>
    <body pos="0 0 .5"><joint axis="0 0 1"/><geom type="capsule" size=".1" fromto="0 0 0 1 0 0"/>
      <camera name="wrist" pos="1 0 .3" xyaxes="0 -1 0 .5 0 1"/>
      <body pos="1 0 0"><joint axis="0 1 0"/><geom type="box" size=".2 .1 .1" rgba="1 0 0 1"/></body>
    </body>
  </worldbody>
</mujoco>
"""


def render_arms(qpos: torch.Tensor, width: int = 16, height: int = 12):
    model = mujoco.MjModel.from_xml_string(ARM)
    sim = Simulation(len(qpos), SimulationCfg(engine="native"), model=model, device="cpu")
    sim.data.qpos.copy_(qpos)
    sim.forward()
    view = CameraView(0, width, height, ALL, (0,), use_shadows=True)
    return sim.render((view,))[0]


def test_environments_are_rendered_alike_however_many_there_are(monkeypatch):
    qpos = torch.rand(11, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    together = render_arms(qpos)
    # Four at a time, then the last three.
    monkeypatch.setattr(native_render, "_RAYS_AT_A_TIME", 4 * 16 * 12)
    in_parts = render_arms(qpos)
    for name in ALL:
        assert getattr(together, name).equal(getattr(in_parts, name)), name
    for i in (0, 5, 10):
        alone = render_arms(qpos[i : i + 1])
        for name in ALL:
            assert getattr(alone, name)[0].equal(getattr(together, name)[i]), name
    assert together.rgb.float().std(dim=0).max() > 10.0, "the environments look different"


def test_a_camera_that_turns_towards_more_geoms_sees_all_of_them():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_joint(axis=[0, 0, 1])
    body.add_geom(size=[0.01, 0, 0], group=3)
    camera = body.add_camera(name="eye", fovy=10)
    camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
    camera.alt.xyaxes = [0, -1, 0, 0, 0, 1]
    for i in range(30):
        angle = 0.1 * (i - 15)
        spec.worldbody.add_geom(size=[0.05, 0, 0], pos=[2 * np.cos(angle), 2 * np.sin(angle), 0])
    model = spec.compile()
    sim = Simulation(1, SimulationCfg(engine="native"), model=model, device="cpu")
    views = (CameraView(0, 64, 8, ("segmentation",), (0,)),)

    def seen(angle: float) -> int:
        sim.data.qpos.fill_(angle)
        sim.forward()
        ids = sim.render(views)[0].segmentation[..., 0]
        return len(ids[ids >= 0].unique())

    # With its back to all of them, with some in sight, and then with all it can see.
    assert seen(np.pi) == 0
    assert 0 < seen(1.8) < 6
    assert seen(0.0) >= 9
    assert seen(np.pi) == 0


@pytest.mark.parametrize("groups", [(0,), (0, 5)])
def test_a_geom_of_a_group_beyond_five_counts_as_five(groups):
    xml = """<mujoco><worldbody><geom size=".5" pos="0 0 -2" group="9"/><camera/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    sim = Simulation(1, SimulationCfg(engine="native"), model=model, device="cpu")
    (images,) = sim.render((CameraView(0, 3, 3, ("segmentation",), groups),))
    assert images.segmentation[0, 1, 1, 0] == (0 if 5 in groups else -1)


def test_nothing_is_seen_beyond_the_far_limit():
    xml = """<mujoco><statistic extent="1"/><visual><map zfar="4"/></visual><worldbody>
      <geom name="near" size=".5" pos="0 0 -{}"/><camera/></worldbody></mujoco>"""
    for distance, depth in ((4.0, 3.5), (5.0, 0.0)):
        model = mujoco.MjModel.from_xml_string(xml.format(distance))
        sim = Simulation(1, SimulationCfg(engine="native"), model=model, device="cpu")
        (images,) = sim.render((CameraView(0, 1, 1, ("depth",), (0,)),))
        assert images.depth.item() == pytest.approx(depth)
