"""Cartpole tasks against the cartpole of dm_control."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.cartpole import cartpole_env_cfg as task
from mjlab.tasks.registry import load_env_cfg

suite = pytest.importorskip("dm_control.suite.cartpole")
rewards = pytest.importorskip("dm_control.utils.rewards")

NUM_ENVS = 64


@pytest.fixture(scope="module")
def env():
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed = NUM_ENVS, 3
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    yield env
    env.close()


@pytest.fixture(scope="module")
def physics():
    return suite.Physics.from_xml_string(*suite.get_model_and_assets())


def suite_reward(physics, qpos, qvel, control) -> float:
    """Return the reward of dm_control for a state and a control."""
    with physics.reset_context():
        physics.data.qpos[:], physics.data.qvel[:] = qpos, qvel
    physics.data.ctrl[:] = control
    return suite.Balance(swing_up=True, sparse=False).get_reward(physics)


def put(env, qpos, qvel, control) -> None:
    data = env.scene["cartpole"].data
    data.write_joint_state(torch.as_tensor(qpos).float(), torch.as_tensor(qvel).float())
    data.joint_effort_target[:] = 0.0
    data.joint_effort_target[:, :1] = torch.as_tensor(control).float()


def test_the_reward_is_the_control_suites_in_random_states(env, physics):
    rng = np.random.default_rng(0)
    qpos = rng.uniform([-2.5, -7.0], [2.5, 7.0], (NUM_ENVS, 2))
    qvel = rng.uniform([-4.0, -12.0], [4.0, 12.0], (NUM_ENVS, 2))
    control = rng.uniform(-1.5, 1.5, (NUM_ENVS, 1))
    # The margins themselves: 2 m, 5 rad/s and a control of 1, next to a state at rest on top.
    qpos[:4], qvel[:4], control[:4] = 0.0, 0.0, 0.0
    qpos[1, 0], qvel[2, 1], control[3, 0] = 2.0, 5.0, 1.0
    put(env, qpos, qvel, control)
    term = env.reward_manager.get_term_cfg("smooth_reward")
    ours = term.func(env, **term.params)
    expected = [suite_reward(physics, *state) for state in zip(qpos, qvel, control, strict=True)]
    np.testing.assert_allclose(ours.numpy(), expected, atol=2e-6)
    np.testing.assert_allclose(ours[:4].numpy(), [1.0, 0.55, 0.55, 0.8], atol=1e-6)


def test_a_step_pays_the_control_suites_reward_of_its_state_and_action(env, physics):
    env.reset()
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        action = 3.0 * torch.rand(NUM_ENVS, 1, generator=generator) - 1.5
        _, reward, _, _, _ = env.step(action)
        data = env.scene["cartpole"].data
        states = zip(data.joint_pos.numpy(), data.joint_vel.numpy(), action.numpy(), strict=True)
        expected = [suite_reward(physics, *state) * env.step_dt for state in states]
        np.testing.assert_allclose(reward.numpy(), expected, atol=1e-6)


@given(x=st.floats(-20, 20), margin=st.sampled_from([0.5, 1.0, 2.0, 5.0]))
def test_the_gaussian_tolerance_is_dm_controls(x, margin):
    value = torch.tensor([x], dtype=torch.float64)
    gaussian = rewards.tolerance(x, margin=margin)
    assert task._gaussian_tolerance(value, margin).item() == pytest.approx(gaussian, abs=1e-9)


def test_the_model_is_the_control_suites(env, physics):
    ours, theirs = env.sim.mj_model, physics.model.ptr
    for body in ("cart", "pole_1"):
        mine, other = ours.body(f"cartpole/{body}"), theirs.body(body)
        for field in ("mass", "inertia", "ipos"):
            np.testing.assert_allclose(getattr(mine, field), getattr(other, field), err_msg=field)
    for joint in ("slider", "hinge_1"):
        mine, other = ours.joint(f"cartpole/{joint}"), theirs.joint(joint)
        for field in ("type", "axis", "range", "limited", "damping", "armature", "frictionloss"):
            np.testing.assert_allclose(getattr(mine, field), getattr(other, field), err_msg=field)
    for field in ("gear", "ctrlrange", "ctrllimited", "gainprm", "biasprm"):
        mine, other = getattr(ours, f"actuator_{field}"), getattr(theirs, f"actuator_{field}")
        np.testing.assert_allclose(mine, other, err_msg=field)


def test_the_pole_angle_has_the_period_of_a_turn(env):
    put(env, np.zeros((NUM_ENVS, 2)) + [0.0, 0.7], np.zeros((NUM_ENVS, 2)), 0.0)
    params = env.observation_manager.get_term_cfg("actor", "pole_angle").params
    once = task.pole_angle_cos_sin(env, **params)
    put(env, np.zeros((NUM_ENVS, 2)) + [0.0, 0.7 + 2 * math.pi], np.zeros((NUM_ENVS, 2)), 0.0)
    torch.testing.assert_close(task.pole_angle_cos_sin(env, **params), once)
    torch.testing.assert_close(once[0], torch.tensor([math.cos(0.7), math.sin(0.7)]))


def test_the_cart_of_the_swing_up_starts_anywhere_near_the_middle(env):
    env.reset()
    cart = env.sim.data.qpos[:, 0]
    assert -0.1 <= cart.min() < -0.05
    assert 0.05 < cart.max() <= 0.1
