"""Headless runs of a policy."""

from __future__ import annotations

import torch
from viewer_fakes import FakeEnv, push

from mjlab.viewer import run_headless


def test_it_steps_as_often_as_asked_and_reports_rewards_and_episodes() -> None:
    env = FakeEnv(2)
    plain_step = env.step

    def step(actions):
        obs, _, _, truncated, extras = plain_step(actions)
        terminated = torch.tensor([env.num_steps == 3, False])
        return obs, torch.tensor([1.0, 3.0]), terminated, truncated, extras

    env.step = step
    seen = []
    result = run_headless(env, push(), 5, on_step=seen.append)
    assert env.num_steps == 5
    assert seen == [1, 2, 3, 4, 5]
    assert (result.num_steps, result.mean_step_reward, result.num_episodes) == (5, 2.0, 1)


def test_rewards_are_told_in_their_unit() -> None:
    env = FakeEnv(1)
    plain = run_headless(env, push(), 2).mean_step_reward
    assert run_headless(env, push(), 2, reward_unit=0.02).mean_step_reward == plain / 0.02


def test_it_takes_the_four_results_of_the_learning_wrapper() -> None:
    env = FakeEnv(2)
    plain_step = env.step

    def step(actions):
        obs, reward, done, _, extras = plain_step(actions)
        return obs, reward, (~done).long(), extras

    env.step = step
    assert run_headless(env, push(), 4).num_episodes == 8
