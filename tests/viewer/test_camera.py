"""Camera resolution shared by all viewers."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from viewer_fakes import FakeEnv

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg
from mjlab.viewer.camera import CameraView, nearest_envs, resolve_camera
from mjlab.viewer.viewer_config import OriginType, ViewerConfig

ENV = FakeEnv(1)
MODEL = ENV.sim.mj_model
CART, POLE = MODEL.body("cartpole/cart").id, MODEL.body("cartpole/pole").id


def resolve(entities=None, **fields) -> CameraView:
    return resolve_camera(ViewerConfig(**fields), MODEL, entities or ENV.scene.entities)


def test_auto_follows_the_first_body_that_can_move_and_not_the_terrain() -> None:
    assert resolve().body_id == CART


def test_auto_looks_at_the_fixed_point_where_nothing_moves() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body/></worldbody></mujoco>")
    view = resolve_camera(ViewerConfig(lookat=(1.0, 2.0, 3.0)), model, {})
    assert view.body_id is None
    np.testing.assert_allclose(view.target(np.zeros((2, 3))), [1, 2, 3])


def test_world_looks_at_the_fixed_point_although_something_moves() -> None:
    assert resolve(origin_type=OriginType.WORLD).body_id is None


def test_asset_root_and_body_are_found_by_entity_and_unprefixed_name() -> None:
    assert resolve(origin_type=OriginType.ASSET_ROOT, entity_name="cartpole").body_id == CART
    view = resolve(origin_type=OriginType.ASSET_BODY, entity_name="cartpole", body_name="pole")
    assert view.body_id == POLE
    positions = np.arange(MODEL.nbody * 3).reshape(-1, 3)
    np.testing.assert_allclose(view.target(positions), positions[POLE])


@pytest.mark.parametrize("body_name", ["hand", "grip/hand"])
def test_a_body_of_an_attached_part_is_found_by_short_and_full_name(body_name) -> None:
    part = mujoco.MjSpec()
    part.worldbody.add_body(name="hand").add_geom(size=(0.1, 0.0, 0.0))

    def spec_fn() -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        base = spec.worldbody.add_body(name="base")
        spec.attach(part.copy(), prefix="grip/", frame=base.add_frame())
        return spec

    scene = Scene(SceneCfg(entities={"robot": EntityCfg(spec_fn=spec_fn)}, num_envs=1), "cpu")
    sim = Simulation(1, SimulationCfg(), scene.compile(), "cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    cfg = ViewerConfig(origin_type=OriginType.ASSET_BODY, body_name=body_name)
    view = resolve_camera(cfg, sim.mj_model, scene.entities)
    assert view.body_id == sim.mj_model.body("robot/grip/hand").id


def test_the_entity_may_be_left_out_where_the_scene_has_exactly_one() -> None:
    assert resolve(origin_type=OriginType.ASSET_ROOT).body_id == CART
    two = {**ENV.scene.entities, "ball": SimpleNamespace()}
    with pytest.raises(
        ValueError, match=r"entity_name.*ASSET_ROOT.*'cartpole', 'ball'\], got None"
    ):
        resolve(two, origin_type=OriginType.ASSET_ROOT)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"entity_name": "robot"}, r"entity_name .*'cartpole'.*got 'robot'"),
        ({"body_name": "leg"}, r"body_name .*'cartpole'.*'pole'.*got 'leg'"),
        ({}, r"body_name.*ASSET_BODY.*'cart', 'pole'.*got None"),
    ],
)
def test_unknown_names_raise_with_the_available_names(fields, message) -> None:
    with pytest.raises(ValueError, match=message):
        resolve(origin_type=OriginType.ASSET_BODY, **fields)


@settings(max_examples=30, deadline=None)
@given(
    azimuth=st.floats(-180, 180),
    elevation=st.floats(-85, 85),
    distance=st.floats(0.5, 20),
)
def test_the_offset_is_where_mujoco_puts_its_own_camera(azimuth, elevation, distance) -> None:
    view = CameraView(None, (0.5, -1.0, 2.0), distance, azimuth, elevation, None)
    camera, scene = mujoco.MjvCamera(), mujoco.MjvScene(MODEL, maxgeom=100)
    camera.lookat[:] = view.lookat
    camera.distance, camera.azimuth, camera.elevation = distance, azimuth, elevation
    data = mujoco.MjData(MODEL)
    mujoco.mjv_updateScene(
        MODEL, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene
    )
    pos = 0.5 * (scene.camera[0].pos + scene.camera[1].pos)
    np.testing.assert_allclose(view.target(data.xpos) + view.offset(), pos, atol=1e-4)
    assert (view.offset()[2] > 0) == (elevation < 0) or abs(elevation) < 1e-6


def test_neighbors_are_nearest_by_origin() -> None:
    origins = np.array([[0, 0, 0], [5, 0, 0], [1, 0, 0], [-2, 0, 0]], dtype=float)
    assert nearest_envs(origins, 0, 2) == [2, 3]
    assert nearest_envs(origins, 0, 99) == [2, 3, 1]
    assert nearest_envs(origins[:1], 0, 2) == []
    # All origins are equal without a terrain.
    assert nearest_envs(np.zeros((4, 3)), 1, 3) == [0, 2, 3]
