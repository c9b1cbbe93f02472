"""Both engines give equal observations and rewards."""

from __future__ import annotations

import pytest
import torch
from tracking_tasks import G1, G1_BLIND, task_cfg, unperturbed

from mjlab.envs import ManagerBasedRlEnv

FRAMES = (20, 90, 150)
STEPS = 3


def make(engine: str, task: str) -> ManagerBasedRlEnv:
    cfg = task_cfg("wave,slow_walk", num_envs=3, task=task, edit=unperturbed, sampling_mode="start")
    cfg.sim.engine = engine
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    # In the middle of the motions, where all velocities differ from zero.
    command = env.command_manager.get_term("motion")
    for index, frame in enumerate(FRAMES):
        command.reset_to_frame(torch.tensor([index]), frame)
    env.sim.forward()
    command.update_relative_body_poses()
    env.sim.sense()
    env.obs_buf = env.observation_manager.compute(update_history=True)
    return env


@pytest.fixture(scope="module", params=[G1, pytest.param(G1_BLIND, marks=pytest.mark.slow)])
def engines(request):
    """The task on both engines, three steps from the same states, with the same actions."""
    envs = {engine: make(engine, request.param) for engine in ("native", "warp")}
    first = {engine: groups(env) for engine, env in envs.items()}
    generator = torch.Generator().manual_seed(0)
    actions = 0.5 * (torch.rand((STEPS, 3, 29), generator=generator) - 0.5)
    rates: dict[str, list[torch.Tensor]] = {engine: [] for engine in envs}
    for action in actions:
        for engine, env in envs.items():
            ended = env.step(action)[2]
            assert not ended.any()
            rates[engine].append(env.reward_manager._step_reward.clone())
    yield envs, first, rates
    for env in envs.values():
        env.close()


def groups(env) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in env.obs_buf.items()}


def test_observations_of_the_same_state_are_the_same(engines):
    _, first, _ = engines
    for name, native in first["native"].items():
        assert native.abs().amax(dim=1).min() > 0.5
        torch.testing.assert_close(first["warp"][name], native, atol=2e-4, rtol=1e-4, msg=name)


def test_observations_stay_the_same_for_a_few_steps(engines):
    envs, first, _ = engines
    native, warp = (groups(envs[engine]) for engine in ("native", "warp"))
    for name in native:
        assert (native[name] - first["native"][name]).abs().max() > 0.1
        torch.testing.assert_close(warp[name], native[name], atol=2e-2, rtol=2e-2, msg=name)


def test_rewards_are_the_same_term_by_term(engines):
    envs, _, rates = engines
    native, warp = (torch.stack(rates[engine]) for engine in ("native", "warp"))
    for index, name in enumerate(envs["native"].reward_manager.active_terms):
        torch.testing.assert_close(
            warp[..., index], native[..., index], atol=2e-3, rtol=2e-2, msg=name
        )
    assert bool((native[..., :6] > 0.02).all())


def test_what_is_derived_from_a_state_is_the_same(engines):
    """Warp copies the state of native; observations, rewards and terminations are equal."""
    envs, _, _ = engines
    native, warp = (envs[engine] for engine in ("native", "warp"))
    for name in ("qpos", "qvel", "ctrl"):
        getattr(warp.sim.data, name).copy_(getattr(native.sim.data, name))
    for env in (native, warp):
        command = env.command_manager.get_term("motion")
        env.sim.forward()
        env.sim.sense()
        command.update_relative_body_poses()
        command._update_metrics()
    commands = [env.command_manager.get_term("motion") for env in (native, warp)]
    for name in ("body_pos_relative_w", "body_quat_relative_w", "robot_body_lin_vel_w"):
        one, other = (getattr(command, name) for command in commands)
        torch.testing.assert_close(other, one, atol=2e-4, rtol=1e-4, msg=name)
    for name, value in commands[0].metrics.items():
        torch.testing.assert_close(commands[1].metrics[name], value, atol=1e-3, rtol=1e-3, msg=name)
    one, other = (env.observation_manager.compute(update_history=True) for env in (native, warp))
    for name in one:
        torch.testing.assert_close(other[name], one[name], atol=5e-4, rtol=1e-3, msg=name)
