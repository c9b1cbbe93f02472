"""All tensors stay float32, whatever torch's default dtype and the dtype of the inputs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from mjlab.actuator import BuiltinMotorActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationTermCfg, RewardTermCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg
from mjlab.tasks.registry import load_env_cfg

NUM_ENVS = 3


@pytest.fixture
def double() -> Iterator[None]:
    """Make float64 torch's default type."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def rollout(task: str, engine: Any, dtype: torch.dtype) -> list[torch.Tensor]:
    """Return what five steps under a default type give, one reset by a time-out among them."""
    torch.set_default_dtype(dtype)
    try:
        cfg = load_env_cfg(task)
        cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, 3, engine
        ones = torch.ones  # Called at every step, in the default type.
        cfg.observations["actor"].terms["own"] = ObservationTermCfg(
            func=lambda env: ones(env.num_envs, 2)
        )
        cfg.rewards["own"] = RewardTermCfg(func=lambda env: ones(env.num_envs), weight=1.0)
        env = ManagerBasedRlEnv(cfg, device="cpu")
        observations, _ = env.reset()
        results = list(observations.values())
        actions = np.random.default_rng(0).uniform(
            -1, 1, (5, NUM_ENVS, *env.action_space.shape[1:])
        )
        for step, action in enumerate(actions):
            if step == 2:
                env.episode_length_buf[1] = env.max_episode_length
            observations, reward, *_ = env.step(torch.tensor(action, dtype=dtype))
            results += [*observations.values(), reward, env.sim.data.qpos.clone()]
        env.close()
    finally:
        torch.set_default_dtype(torch.float32)
    return results


@pytest.mark.parametrize(
    ("task", "engine"),
    [
        ("Mjlab-Velocity-Rough-Unitree-Go1", "native"),
        pytest.param("Mjlab-Lift-Cube-Yam", "native", marks=pytest.mark.slow),
        pytest.param("Mjlab-Lift-Cube-Yam-Depth", "native", marks=pytest.mark.slow),
        pytest.param("Mjlab-Lift-Cube-Yam-Rgb", "native", marks=pytest.mark.slow),
        pytest.param("Mjlab-Multi-Cube-Seg-Yam", "native", marks=pytest.mark.slow),
        ("Mjlab-Cartpole-Swingup", "native"),
        pytest.param("Mjlab-Cartpole-Swingup", "warp", marks=pytest.mark.slow),
    ],
)
def test_a_rollout_is_the_same_under_default_float64(task: str, engine: str):
    single, double = (rollout(task, engine, dtype) for dtype in (torch.float32, torch.float64))
    for expected, found in zip(single, double, strict=True):
        assert found.dtype == expected.dtype == torch.float32
        assert torch.equal(found, expected)


XML = """
<mujoco>
  <worldbody>
    <body name="base" {mocap}>
      {root}
      <geom size=".1"/>
      <body pos="0 0 1"><joint name="j"/><geom size=".1"/>
        <body pos="0 0 1"><joint name="k"/><geom size=".1"/><site name="s"/></body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
</mujoco>
"""


def make_entity(floating: bool) -> Any:
    xml = XML.format(mocap="", root="<freejoint/>" if floating else "")
    motors = tuple(
        BuiltinMotorActuatorCfg(target_names_expr=names, transmission_type=kind, effort_limit=9.0)
        for names, kind in ((("j", "k"), "joint"), (("t",), "tendon"), (("s",), "site"))
    )
    cfg = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(xml),
        articulation=EntityArticulationInfoCfg(actuators=motors),
    )
    scene = Scene(SceneCfg(num_envs=NUM_ENVS, entities={"robot": cfg}), device="cpu")
    sim = Simulation(NUM_ENVS, SimulationCfg(), spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    return scene["robot"]


# By name: the width of its values, and the data or target that it writes.
WRITERS = {
    "write_root_state_to_sim": (13, "qpos"),
    "write_root_link_pose_to_sim": (7, "qpos"),
    "write_root_link_velocity_to_sim": (6, "qvel"),
    "write_root_link_velocity_b_to_sim": (6, "qvel"),
    "write_root_com_velocity_to_sim": (6, "qvel"),
    "write_joint_position_to_sim": (2, "qpos"),
    "write_joint_velocity_to_sim": (2, "qvel"),
    "write_ctrl_to_sim": (4, "ctrl"),
    "write_mocap_pose_to_sim": (7, "mocap_pos"),
    "set_joint_position_target": (2, "joint_pos_target"),
    "set_joint_velocity_target": (2, "joint_vel_target"),
    "set_joint_effort_target": (2, "joint_effort_target"),
    "set_tendon_len_target": (1, "tendon_len_target"),
    "set_tendon_vel_target": (1, "tendon_vel_target"),
    "set_tendon_effort_target": (1, "tendon_effort_target"),
    "set_site_effort_target": (1, "site_effort_target"),
}


@pytest.mark.parametrize("env_ids", [None, torch.tensor([2, 0])], ids=("all", "some"))
@pytest.mark.parametrize("convert", [torch.from_numpy, np.asarray, np.ndarray.tolist])
@pytest.mark.parametrize("name", WRITERS)
def test_writers_take_values_of_any_float_type(name: str, convert: Any, env_ids: Any):
    entity = make_entity(floating="mocap" not in name)
    width, written = WRITERS[name]
    rows = NUM_ENVS if env_ids is None else len(env_ids)
    values = np.random.default_rng(1).normal(size=(rows, width))

    def field() -> torch.Tensor:
        source = entity.data if "target" in written else entity.data.data
        return getattr(source, written)

    before = field().clone()
    getattr(entity, name)(convert(values), env_ids=env_ids)
    found = field().clone()
    field().copy_(before)
    getattr(entity, name)(torch.from_numpy(values).float(), env_ids=env_ids)
    assert found.dtype == torch.float32
    assert not torch.equal(found, before)
    torch.testing.assert_close(found, field(), rtol=1e-6, atol=1e-6)


def test_wrenches_take_float64(double):
    entity = make_entity(floating=True)
    force = np.arange(NUM_ENVS * 9.0).reshape(NUM_ENVS, 3, 3)
    entity.write_external_wrench_to_sim(force, torch.zeros(NUM_ENVS, 3, 3))
    found = entity.data.body_external_force
    assert found.dtype == torch.float32
    np.testing.assert_array_equal(found.numpy(), force)
