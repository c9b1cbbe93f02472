"""Drives differ between environments, within the ranges of the guide."""

from __future__ import annotations

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.velocity.velocity_env_cfg import randomize_drives

NUM_ENVS = 16
FRICTION = {".*_hip_joint": (0.1, 0.2), ".*_(thigh|calf)_joint": (0.3, 0.6)}


@pytest.fixture(scope="module")
def env():
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1-No-State-Estimation")
    cfg.scene.num_envs, cfg.seed = NUM_ENVS, 1
    randomize_drives(cfg, FRICTION)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    yield env
    env.close()


@pytest.mark.parametrize(
    ("field", "factors"),
    [("dof_armature", (0.8, 1.2)), ("actuator_forcerange", (0.9, 1.1))],
)
def test_factors(env, field: str, factors: tuple[float, float]) -> None:
    default = env.sim.get_default_field(field)
    ratio = (getattr(env.sim.model, field) / default)[:, default != 0.0]
    assert factors[0] <= ratio.min() < 0.95
    assert 1.05 < ratio.max() <= factors[1]


def test_gains(env) -> None:
    default = env.sim.get_default_field("actuator_biasprm")
    for axis in (1, 2):
        ratio = env.sim.model.actuator_biasprm[:, :, axis] / default[:, axis]
        assert 0.9 <= ratio.min() < 0.95
        assert 1.05 < ratio.max() <= 1.1
    # The servo stays one: the same gain on target and position.
    assert torch.equal(
        env.sim.model.actuator_gainprm[..., 0], -env.sim.model.actuator_biasprm[..., 1]
    )


def test_joint_friction(env) -> None:
    robot = env.scene["robot"]
    friction = env.sim.model.dof_frictionloss[:, robot.data.indexing.joint_v_adr]
    is_hip = torch.tensor(["hip" in name for name in robot.joint_names])
    assert friction[:, is_hip].min() >= 0.1
    assert friction[:, is_hip].max() <= 0.2
    assert friction[:, ~is_hip].min() >= 0.3
    assert friction[:, ~is_hip].max() <= 0.6


def test_latency_is_kept_for_an_episode(env) -> None:
    for actuator in env.scene["robot"].actuators:
        assert actuator.has_delay
        assert actuator.cfg.delay_max_lag * env.physics_dt == pytest.approx(0.015)
        assert actuator.cfg.delay_hold_prob == 1.0


@pytest.mark.parametrize(
    ("physics_steps", "lags"), [(None, (1, 3)), (3, (1, 2)), (2, (0, 2)), (1, (0, 1))]
)
def test_latency_keeps_its_time_with_the_cpu_profile(physics_steps, lags) -> None:
    task = "Mjlab-Velocity-Flat-Unitree-Go1-No-State-Estimation"
    cfg = load_env_cfg(task)
    randomize_drives(cfg)
    robot = cfg.scene.entities["robot"]
    for actuator in robot.articulation.actuators:
        actuator.delay_min_lag = 1
    cpu_profile(physics_steps=physics_steps).easing(cfg, load_rl_cfg(task))
    for actuator in robot.articulation.actuators:
        assert (actuator.delay_min_lag, actuator.delay_max_lag) == lags
        # 5 and 15 ms, within half a substep.
        half = 0.5 * cfg.sim.mujoco.timestep + 1e-9
        assert abs(actuator.delay_min_lag * cfg.sim.mujoco.timestep - 0.005) <= half
        assert abs(actuator.delay_max_lag * cfg.sim.mujoco.timestep - 0.015) <= half


def test_other_tasks_of_the_robot_are_unchanged() -> None:
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    randomize_drives(cfg)
    other = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    assert all(a.delay_max_lag == 0 for a in other.scene.entities["robot"].articulation.actuators)
    assert "gains" not in other.events
