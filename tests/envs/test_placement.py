"""Fixed bases that stay where they are while terms read the origins of the environments."""

from __future__ import annotations

import warnings

import mujoco
import pytest
import torch

from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.managers import (
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
)
from mjlab.scene import SceneCfg
from mjlab.tasks.registry import load_env_cfg
from mjlab.terrains import TerrainEntityCfg

ARM = """
<mujoco><worldbody><body name="base"><geom size=".1"/>
  <body pos="0 0 .2"><joint name="hinge" axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body>
</body></worldbody></mujoco>
"""
FLOOR = '<mujoco><worldbody><body><geom type="plane" size="9 9 1"/></body></worldbody></mujoco>'
PLACE = EventTermCfg(
    func=mdp.reset_root_state_uniform,
    mode="reset",
    params={"pose_range": {}, "asset_cfg": SceneEntityCfg("arm")},
)
DEFAULT = EventTermCfg(func=mdp.reset_scene_to_default, mode="reset")


def distance(env):
    offset = env.scene["arm"].data.root_link_pos_w - env.scene.env_origins
    return offset.norm(dim=-1)


def distance_by_terrain(env):
    offset = env.scene["arm"].data.root_link_pos_w - env.scene.terrain.env_origins
    return offset.norm(dim=-1)


def joints(env):
    return env.scene["arm"].data.joint_pos


def make(events=None, reward=distance, terrain=True, floor=False) -> ManagerBasedRlEnv:
    arm = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(ARM))
    ground = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(FLOOR))
    cfg = ManagerBasedRlEnvCfg(
        decimation=1,
        scene=SceneCfg(
            num_envs=2,
            terrain=TerrainEntityCfg() if terrain else None,
            entities={"arm": arm, **({"floor": ground} if floor else {})},
        ),
        observations={"actor": ObservationGroupCfg({"joints": ObservationTermCfg(func=joints)})},
        rewards={"near": RewardTermCfg(func=reward, weight=1.0)} if reward else {},
        events=events or {},
        episode_length_s=1.0,
    )
    return ManagerBasedRlEnv(cfg, device="cpu")


def run(env, steps=2) -> list[str]:
    """Return the warnings of a reset and some steps."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        env.reset()
        for _ in range(steps):
            env.step(torch.zeros(env.num_envs, env.action_manager.total_action_dim))
        env.reset()
    assert all(one.filename == __file__ for one in seen)
    return [str(one.message) for one in seen]


@pytest.mark.parametrize("reward", [distance, distance_by_terrain])
def test_a_base_that_is_not_placed_is_reported_once(reward):
    env = make(reward=reward)
    (message,) = run(env)
    assert "'arm'" in message
    assert "reset_root_state_uniform" in message
    assert run(env) == []


@pytest.mark.parametrize(
    "settings",
    [
        {"events": {"place": PLACE}},
        {"events": {"default": DEFAULT}},
        {"events": {"default": DEFAULT}, "floor": True},
        {"events": {"place": PLACE}, "floor": True},
        {"reward": None},
        {"terrain": False},
    ],
)
def test_bases_that_are_placed_or_not_compared_with_origins_are_silent(settings):
    assert run(make(**settings)) == []


def test_reads_between_steps_do_not_count():
    env = make(reward=None)
    assert run(env) == []
    # As viewers do.
    assert env.scene.env_origins.any()
    assert run(env) == []


def test_the_cartpole_is_silent():
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.sim.engine = 4, "native"
    assert run(ManagerBasedRlEnv(cfg, device="cpu")) == []
