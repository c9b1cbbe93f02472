"""Cameras of the world belong to their environments."""

from __future__ import annotations

import mujoco
import pytest
import torch

from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.managers import EventTermCfg, SceneEntityCfg
from mjlab.scene import SceneCfg
from mjlab.sensor import CameraSensorCfg
from mjlab.terrains import BoxFlatTerrainCfg, TerrainEntityCfg, TerrainGeneratorCfg

from .camera_scenes import ENGINES

# A ball above the origin, and a camera that looks down at it from 2 m.
BALL = """
<mujoco><worldbody>{fixed}<body name="ball" pos="0 0 .5">{joint}
  <geom name="ball" size=".3" mass="1"/></body></worldbody></mujoco>
"""
CAMERA = '<camera name="above" pos="0 0 2.5"/>'
PLANE = TerrainEntityCfg()
GRID = TerrainEntityCfg(
    terrain_type="generator",
    max_init_terrain_level=0,
    terrain_generator=TerrainGeneratorCfg(
        size=(4.0, 4.0), num_rows=3, curriculum=True, sub_terrains={"flat": BoxFlatTerrainCfg()}
    ),
)


def make_env(sensor, engine="native", num_envs=3, joint="<freejoint/>", terrain=PLANE, **events):
    xml = BALL.format(fixed=CAMERA, joint=joint)
    ball = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(xml))
    # A fixed base is attached at the initial position.
    ball.init_state.pos = (0.0, 0.0, 0.5 if joint else 0.0)
    cfg = ManagerBasedRlEnvCfg(
        decimation=1,
        scene=SceneCfg(
            num_envs=num_envs,
            terrain=terrain,
            entities={"ball": ball},
            sensors=(sensor,),
            env_spacing=4.0,
        ),  # fmt: skip
        observations={},
        events={"start": EventTermCfg(func=mdp.reset_scene_to_default, mode="reset"), **events},
        episode_length_s=10.0,
    )
    cfg.sim.mujoco.gravity = (0.0, 0.0, 0.0)
    cfg.sim.engine = engine
    return ManagerBasedRlEnv(cfg, device="cpu")


def pixels_of_the_ball(env) -> list[int]:
    ball = env.sim.mj_model.geom("ball/ball").id
    seen = env.scene["eye"].data.segmentation[..., 0] == ball
    return seen.flatten(1).sum(dim=1).tolist()


def eye(**fields) -> CameraSensorCfg:
    return CameraSensorCfg(
        name="eye", width=16, height=12, data_types=("segmentation", "depth"), **fields
    )


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("fields", [{"pos": (0.0, 0.0, 2.5)}, {"camera_name": "ball/above"}])
@pytest.mark.parametrize("joint", ["<freejoint/>", ""])
def test_camera_sees_the_ball_of_its_environment(fields, engine, joint):
    env = make_env(eye(**fields), engine, joint=joint)
    env.reset()
    # A radius of 0.3 m at 2 m: 0.15 / tan(22.5 deg) * 6 pixels = 2.2 pixels.
    pixels = pixels_of_the_ball(env)
    assert pixels[2] == pytest.approx(torch.pi * 2.2**2, abs=4)
    assert pixels == [pixels[2]] * 3
    env.step(torch.zeros(3, 0))
    assert pixels_of_the_ball(env) == pixels
    env.close()


def test_camera_of_one_environment_stays():
    env = make_env(eye(pos=(0.0, 0.0, 2.5)), num_envs=1)
    env.reset()
    assert env.sim.model.cam_pos[0, env.scene["eye"].camera_idx].tolist() == [0.0, 0.0, 2.5]
    assert pixels_of_the_ball(env)[0] > 0
    env.close()


@pytest.mark.parametrize("engine", ENGINES)
def test_camera_follows_the_origin_of_its_environment(engine):
    env = make_env(eye(pos=(0.0, 0.0, 2.5)), engine, terrain=GRID)
    env.reset()
    pixels = pixels_of_the_ball(env)
    assert pixels[0] > 0
    ids = torch.tensor([1])
    up = torch.tensor([True])
    env.scene.terrain.update_env_origins(ids, up, ~up)
    env.reset(env_ids=ids)
    assert pixels_of_the_ball(env) == pixels
    places = env.sim.data.cam_xpos[:, env.scene["eye"].camera_idx]
    expected = env.scene.env_origins + torch.tensor([0.0, 0.0, 2.5])
    torch.testing.assert_close(places, expected)
    assert places[1, 0] != places[0, 0]
    env.close()


@pytest.mark.parametrize("mode", ["startup", "reset", "interval"])
def test_randomized_camera_stays_in_its_environment(mode):
    higher = EventTermCfg(
        func=mdp.dr.cam_pos,
        mode=mode,
        interval_range_s=(0.001, 0.001) if mode == "interval" else None,
        params={
            "ranges": {2: (1.0, 1.0)},
            "operation": "add",
            "asset_cfg": SceneEntityCfg("ball", camera_names=("above",)),
        },
    )
    env = make_env(eye(camera_name="ball/above"), terrain=GRID, higher=higher)
    env.reset()
    for _ in range(2):
        env.step(torch.zeros(3, 0))
    env.reset(env_ids=torch.tensor([1]))
    env.step(torch.zeros(3, 0))
    places = env.sim.data.cam_xpos[:, env.scene["eye"].camera_idx]
    expected = env.scene.env_origins + torch.tensor([0.0, 0.0, 3.5])
    torch.testing.assert_close(places, expected)
    env.close()


def test_camera_on_a_body_stays_with_it():
    env = make_env(eye(parent_body="ball/ball", pos=(0.0, 0.0, 2.0)))
    env.reset()
    assert min(pixels_of_the_ball(env)) > 0
    assert not env.scene.world_cameras
    env.close()
