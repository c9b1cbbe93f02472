"""Cameras of both engines show the same, and MuJoCo's own renderer the same depths."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from mjlab.entity import VariantEntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import CameraSensorCfg, CameraSensorData
from mjlab.sim import Simulation, SimulationCfg

from .camera_scenes import BALL, ENGINES, ROOM, scene_with, sense

# Measured here: depths 0.00002 m near by, no pixel of another object, colors 0.0002
# to 0.08 of 255 on average. Single pixels differ where a texture is finer than they are.
DEPTH = 1e-3
MEAN_COLOUR, SINGLE_COLOUR, SINGLE_PIXELS = 0.5, 3, 0.01
# Farther away (metres), a depth is held to this part of it.
FAR, RELATIVE = 20.0, 5e-5

NUM_ENVS = 3
SENSORS = tuple(
    CameraSensorCfg(
        name=f"{camera} {width}",
        camera_name=f"room/{camera}",
        width=width,
        height=height,
        data_types=data_types,
        use_shadows=shadows,
        enabled_geom_groups=groups,
    )
    for camera, width, height, data_types, shadows, groups in (
        ("front", 64, 48, ("rgb", "depth", "segmentation"), False, (0, 1, 2)),
        ("front", 33, 17, ("depth", "rgb"), True, (0, 4)),
        ("lens", 32, 32, ("rgb", "depth", "segmentation"), False, (0, 1, 2)),
        ("top", 47, 40, ("rgb", "depth", "segmentation"), True, (0, 4)),
        ("top", 20, 10, ("segmentation",), False, (0,)),
    )
)
# Randomized fields by environment: element, values.
RANDOMIZED = {
    "cam_fovy": (2, "camera", "room/front", 80.0),
    "cam_pos": (1, "camera", "room/top", [0.317, 0.123, 1.5]),
    "cam_quat": (
        0,
        "camera",
        "room/top",
        [math.cos(0.1), 0.6 * math.sin(0.1), 0.8 * math.sin(0.1), 0.0],
    ),
    "cam_intrinsic": (1, "camera", "room/lens", [0.002, 0.0022, 0.0002, -0.0001]),
    "light_diffuse": (0, "light", "room/spot", [0.0, 0.9, 0.2]),
    "light_pos": (2, "light", "room/bulb", [0.0, 0.0, 0.8]),
    "light_dir": (1, "light", "room/sun", [0.6, 0.0, -0.8]),
    "light_cutoff": (2, "light", "room/spot", 50.0),
    "light_exponent": (1, "light", "room/spot", 2.0),
    "light_attenuation": (1, "light", "room/spot", [1.0, 0.3, 0.0]),
    "light_ambient": (2, "light", "room/spot", [0.1, 0.0, 0.2]),
    "light_specular": (2, "light", "room/bulb", [0.5, 0.5, 0.5]),
    "geom_rgba": (1, "geom", "room/capsule", [0.1, 0.9, 0.3, 1.0]),
    "geom_size": (2, "geom", "room/box", [0.1, 0.2, 0.1]),
    "geom_pos": (0, "geom", "room/cylinder", [0.5, 0.4, 0.3]),
    "mat_rgba": (1, "mat", "room/shiny", [0.9, 0.2, 0.9, 1.0]),
    "mat_emission": (0, "mat", "room/dull", 0.6),
    "mat_shininess": (2, "mat", "room/shiny", 0.2),
    "mat_specular": (1, "mat", "room/dull", 0.9),
    "mat_texrepeat": (2, "mat", "room/dull", [2.0, 3.0]),
    "mat_texid": (0, "mat", "room/dull", [-1, 0, -1, -1, -1, -1, -1, -1, -1, -1]),
}


def render(engine: str, randomized: bool) -> dict[str, CameraSensorData]:
    sim, scene = scene_with(
        *SENSORS, xml=ROOM, engine=engine, num_envs=NUM_ENVS, extent=2.0, ball=BALL
    )
    if randomized:
        sense(sim)
        sim.expand_model_fields([*RANDOMIZED, "geom_dataid"])
        for field, (env, kind, name, values) in RANDOMIZED.items():
            element = getattr(sim.mj_model, kind)(name).id
            row = getattr(sim.model, field)[env, element]
            row.copy_(torch.as_tensor(values, dtype=row.dtype))
        # Environments may hold different things: one has no mesh, and one no sphere.
        sim.model.geom_dataid[1, sim.mj_model.geom("room/tetra").id] = -1
        sim.model.geom_size[2, sim.mj_model.geom("room/sphere").id] = 0.0
    place = torch.tensor([[-0.2, -0.2, 0.5], [0.1, -0.3, 0.6], [0.0, 0.0, 1.5]])
    pose = torch.cat((place, torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4)), dim=1)
    scene["ball"].write_root_link_pose_to_sim(pose)
    sense(sim)
    return {sensor.name: scene[sensor.name].data for sensor in SENSORS}


@pytest.fixture(scope="module", params=[False, True], ids=["as compiled", "randomized"])
def images(request):
    return {engine: render(engine, request.param) for engine in ENGINES}


@pytest.fixture(params=[sensor.name for sensor in SENSORS])
def pair(request, images):
    return images["native"][request.param], images["warp"][request.param]


def test_segmentation_is_the_same(pair):
    native, warp = pair
    if native.segmentation is not None:
        assert native.segmentation.equal(warp.segmentation)
        assert (native.segmentation[..., 0] >= 0).any()


def test_depth_is_the_same_to_a_millimetre(pair):
    native, warp = pair
    if native.depth is not None:
        allowed = torch.where(warp.depth > FAR, RELATIVE * warp.depth, DEPTH)
        assert ((native.depth - warp.depth).abs() <= allowed).all()
        assert native.depth.max() > 1.0


def test_colors_are_the_same_to_a_few_gray_levels(pair):
    native, warp = pair
    if native.rgb is not None:
        difference = (native.rgb.int() - warp.rgb.int()).abs()
        assert difference.float().mean() < MEAN_COLOUR
        assert (difference > SINGLE_COLOUR).float().mean() < SINGLE_PIXELS
        assert native.rgb.float().std() > 20.0


def test_each_environment_sees_its_own_variant():
    shapes = {
        "cube": {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": (0.1, 0.1, 0.1)},
        "ball": {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": (0.1, 0.0, 0.0)},
        "wedge": {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": "wedge"},
    }
    eye = CameraSensorCfg(name="eye", width=16, height=16, data_types=("rgb", "segmentation"))
    images = {}
    for engine in ENGINES:
        entity = VariantEntityCfg(variants={n: lambda n=n: _spec_of(shapes[n]) for n in shapes})
        scene = Scene(
            SceneCfg(num_envs=3, entities={"object": entity}, sensors=(eye,), extent=2.0), "cpu"
        )
        sim = Simulation(
            3,
            SimulationCfg(engine=engine),
            spec=scene.spec,
            variant_info=scene.collect_variant_info(),
            device="cpu",
        )
        scene.initialize(sim.mj_model, sim.model, sim.data)
        sim.set_sensor_context(scene.sensor_context)
        sense(sim)
        images[engine] = scene["eye"].data
    native, warp = images["native"], images["warp"]
    assert native.segmentation.equal(warp.segmentation)
    assert (native.rgb.int() - warp.rgb.int()).abs().float().mean() < MEAN_COLOUR
    seen = [set(ids.unique().tolist()) - {-1} for ids in native.segmentation[..., 0]]
    assert [len(ids) for ids in seen] == [1, 1, 1]
    assert len(set.union(*seen)) == 3


def _spec_of(geom: dict) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    if "meshname" in geom:
        corners = [0, 0, 0.15, 0.15, 0, -0.05, -0.1, 0.1, -0.05, -0.05, -0.15, -0.1]
        spec.add_mesh(
            name="wedge", uservert=corners, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        )
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint()
    body.add_geom(**geom)
    return spec


def test_what_was_randomized_is_seen():
    """The parity of randomized images would say nothing if they were those of the model."""
    plain, other = render("native", randomized=False), render("native", randomized=True)
    for sensor in SENSORS[:4]:
        changed = plain[sensor.name].rgb != other[sensor.name].rgb
        assert changed.flatten(1).float().mean(dim=1).gt(0.001).all(), sensor.name


def test_depths_are_those_of_the_renderer_of_mujoco(gl):
    from mjlab.viewer.offscreen_renderer import open_renderer

    names = ("front", "top")
    sensors = [
        CameraSensorCfg(
            name=name, camera_name=f"room/{name}", width=64, height=48, data_types=("depth",)
        )
        for name in names
    ]
    sim, scene = scene_with(*sensors, xml=ROOM, extent=2.0, ball=BALL)
    sense(sim)
    data = sim.copy_to_host(0)
    mujoco.mj_forward(sim.mj_model, data)
    renderer = open_renderer(sim.mj_model, 48, 64)
    renderer.enable_depth_rendering()
    for name in names:
        renderer.update_scene(data, f"room/{name}")
        reference = renderer.render()
        depth = scene[name].data.depth[0, ..., 0].numpy()
        # Round shapes are made of triangles there, and pixels at edges may show either side.
        near = reference < 5.0
        difference = np.abs(depth - reference)[near & (depth > 0.0)]
        assert np.median(difference) < 1e-3
        assert (difference < 5e-3).mean() > 0.95, name
    renderer.close()
