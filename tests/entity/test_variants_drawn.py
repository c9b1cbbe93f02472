"""Viewers draw every environment's own variant."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.entity import EntityCfg, VariantEntityCfg
from mjlab.sensor import CameraSensorCfg, CameraSensorData
from mjlab.sim import Simulation
from mjlab.viewer.model_sync import compute_poses, copy_state, host_model, sync_model_fields
from mjlab.viewer.viser.scene import MjlabViserScene

from .variant_objects import THINGS, make_scene, plain, present_geoms, simulate, thing


def of_all_things() -> Simulation:
    sim = simulate(make_scene(5, {"thing": VariantEntityCfg(variants=THINGS)}))
    sim.data.qpos[:, 2] = torch.linspace(1.0, 1.4, 5)
    sim.forward()
    return sim


def drawn(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple]:
    """Return what of things MuJoCo draws: type, size, color and place."""
    scene, option = mujoco.MjvScene(model, maxgeom=100), mujoco.MjvOption()
    everything = int(mujoco.mjtCatBit.mjCAT_ALL)
    mujoco.mjv_updateScene(model, data, option, None, mujoco.MjvCamera(), everything, scene)
    shown = []
    for geom in scene.geoms[: scene.ngeom]:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE or geom.rgba[3] == 0:
            continue
        mesh = ""
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            # Two shapes belong to each mesh: itself and its hull.
            mesh = model.mesh(geom.dataid // 2).name.rsplit("/", 1)[-1]
        values = (geom.size, geom.rgba, geom.pos, geom.mat)
        numbers = [np.asarray(value).ravel().astype(float).round(4).tolist() for value in values]
        shown.append((int(geom.type), mesh, str(numbers).replace("-0.0,", "0.0,")))
    return sorted(shown)


def test_the_host_model_of_each_environment_shows_its_own_variant() -> None:
    sim = of_all_things()
    model = host_model(sim.mj_model)
    data = mujoco.MjData(model)
    # Back and forth: nothing of another environment may stay.
    for env in (0, 1, 2, 3, 4, 3, 1, 0):
        sync_model_fields(model, sim.model, sim.expanded_fields, env)
        copy_state(sim, env, data)
        compute_poses(model, data)
        alone = simulate(make_scene(1, {"thing": plain(list(THINGS.values())[env])}))
        alone.data.qpos[0] = sim.data.qpos[env]
        reference = mujoco.MjData(alone.mj_model)
        copy_state(alone, 0, reference)
        mujoco.mj_forward(alone.mj_model, reference)
        assert drawn(model, data) == drawn(alone.mj_model, reference)


def test_contacts_computed_on_the_host_are_those_of_the_environment() -> None:
    sim = of_all_things()
    sim.data.qpos[:, 2] = -0.01
    model = host_model(sim.mj_model)
    data = mujoco.MjData(model)
    for env in range(5):
        sync_model_fields(model, sim.model, sim.expanded_fields, env)
        copy_state(sim, env, data)
        mujoco.mj_forward(model, data)
        alone = simulate(make_scene(1, {"thing": plain(list(THINGS.values())[env])})).mj_model
        reference = mujoco.MjData(alone)
        reference.qpos[:] = data.qpos
        mujoco.mj_forward(alone, reference)
        assert data.ncon == reference.ncon > 0


def test_contacts_of_shapes_larger_than_compiled_are_found_on_the_host() -> None:
    pair = '<geom size="{0}" pos=".2 0 0"/><geom size="{0}" pos="-.2 0 0"/>'
    sizes = {"small": 0.05, "large": 0.15}
    variants = {name: thing(name, pair.format(size)) for name, size in sizes.items()}
    sim = simulate(make_scene(2, {"thing": VariantEntityCfg(variants=variants)}))
    sim.data.qpos[:, 2] = 0.1
    model = host_model(sim.mj_model)
    data = mujoco.MjData(model)
    sync_model_fields(model, sim.model, sim.expanded_fields, 1)
    copy_state(sim, 1, data)
    mujoco.mj_forward(model, data)
    assert data.ncon == 2


def test_the_page_draws_each_environment_with_its_own_shapes(viser_server) -> None:
    sim = of_all_things()
    scene = MjlabViserScene(viser_server, sim.mj_model, 5, sim.model, sim.expanded_fields)
    scene.update(sim)
    shapes = scene._variants._shapes.values()
    body, lid = sim.mj_model.body("thing/thing").id, sim.mj_model.body("thing/lid").id
    of_things = sorted(tuple(shape.envs) for shape in shapes if body in shape.bodies)
    # The visual meshes of the fourth and the fifth variant are in separate groups.
    assert of_things == [(0,), (1,), (2,), (3,), (3,), (4,), (4,)]
    lids = sorted(tuple(shape.envs) for shape in shapes if lid in shape.bodies)
    assert lids == [(0, 1, 3, 4), (2,)]


CAMERA = CameraSensorCfg(
    name="above", pos=(0.0, 0.0, 2.0), width=24, height=24, data_types=("rgb", "depth"), fovy=30.0
)


@pytest.mark.parametrize(
    "engine",
    [
        "native",
        pytest.param("warp", marks=pytest.mark.slow),
    ],
)
def test_cameras_show_each_environment_its_own_variant(engine: str) -> None:
    def images(num_envs: int, cfg: EntityCfg, engine: str) -> CameraSensorData:
        scene = make_scene(num_envs, {"thing": cfg}, (CAMERA,))
        sim = simulate(scene, engine)
        sim.set_sensor_context(scene.sensor_context)
        sim.data.qpos[:, 2], sim.data.qpos[:, 4] = 0.5, 0.3
        sim.forward()
        sim.sense()
        return scene["above"].data

    found = images(5, VariantEntityCfg(variants=THINGS), engine)
    shown = set()
    for env, make in enumerate(THINGS.values()):
        alone = images(1, plain(make), "native")
        near = (found.depth[env] - alone.depth[0]).abs() < 1e-3
        alike = (found.rgb[env].int() - alone.rgb[0].int()).abs() <= 8
        # On edges the engines may see one surface or the other.
        share = 1.0 if engine == "native" else 0.98
        assert near.float().mean() >= share
        assert alike.float().mean() >= share
        shown.add(tuple(found.depth[env].flatten().round(decimals=3).tolist()))
    assert len(shown) == 5


WITH_UV = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
WITH_UV += "f 1/1 3/3 2/2\nf 1/1 2/2 4/3\nf 1/1 4/3 3/2\nf 2/1 3/2 4/3\n"
SHADES = {"dark": 40, "mid": 120, "light": 220}
FILES = (
    '<texture name="skin" type="2d" file="skin.png"/><mesh name="m" file="m.obj" scale=".1 .1 .1"/>'
)
TEXTURED = """<mujoco><asset>{files}<texture name="plain" type="2d" builtin="flat" width="2" height="2"
  rgb1=".2 .2 .2"/><material name="paint" texture="skin"/><material name="base" texture="plain"/>
  </asset><worldbody><body name="thing"><freejoint/>
  <geom type="mesh" mesh="m" material="paint" contype="0" conaffinity="0"/>
  <geom type="mesh" mesh="m" material="base"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("in_memory", [False, True])
def test_meshes_of_each_variant_keep_their_textures(tmp_path, in_memory) -> None:
    """Each variant has separate files under the same names."""
    from matplotlib import image

    def make(name: str) -> mujoco.MjSpec:
        folder = tmp_path / name
        xml = TEXTURED.format(files=FILES)
        if in_memory:
            assets = {file.name: file.read_bytes() for file in folder.iterdir()}
            return mujoco.MjSpec.from_string(xml, assets=assets)
        (folder / "thing.xml").write_text(xml)
        return mujoco.MjSpec.from_file(str(folder / "thing.xml"))

    for name, shade in SHADES.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "m.obj").write_text(WITH_UV)
        image.imsave(tmp_path / name / "skin.png", np.full((4, 4, 3), shade, np.uint8))
    variants = {name: lambda name=name: make(name) for name in SHADES}
    sim = simulate(make_scene(3, {"thing": VariantEntityCfg(variants=variants)}))
    model = sim.mj_model
    role = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    for env, shade in enumerate(SHADES.values()):
        materials = sim.model.geom_matid[env, present_geoms(sim, env, "thing/thing")]
        textures = [model.mat_texid[material, role] for material in materials.tolist()]
        pixels = [model.tex_data[model.tex_adr[t]] for t in textures]
        assert sorted(pixels) == sorted([shade, 51])
