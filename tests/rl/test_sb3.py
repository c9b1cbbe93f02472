"""Environments as Stable-Baselines3 sees them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from rl_ending_env import TASK, ending_env
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl.sb3 import Sb3VecEnv
from mjlab.tasks.registry import load_env_cfg
from mjlab.viewer.offscreen_renderer import RenderingUnavailableError

NUM_ENVS = 3


@pytest.fixture
def make() -> Iterator[Any]:
    made = []

    def make(auto_reset: bool = True, **kwargs: Any) -> Sb3VecEnv:
        # Environment 2 runs out of time as it fails.
        env = ending_env(failed=[3, 99, 5], time_out=[99, 4, 5], auto_reset=auto_reset)
        made.append(Sb3VecEnv(env, **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()


def test_ends_are_told_as_stable_baselines_wants_them(make):
    env = make()
    env.seed(1)
    first = env.reset()
    assert first.shape == (NUM_ENVS, 5)
    rewards, ends = np.zeros(NUM_ENVS), {}
    for step in range(1, 6):
        observations, reward, dones, infos = env.step(np.zeros((NUM_ENVS, 1), np.float32))
        rewards += reward
        for row in dones.nonzero()[0]:
            ends[int(row)] = step, infos[row], observations[row], rewards[row]
            rewards[row] = 0.0
        assert all(not info for row, info in enumerate(infos) if not dones[row])
    assert {row: end[0] for row, end in ends.items()} == {0: 3, 1: 4, 2: 5}
    assert [ends[row][1]["TimeLimit.truncated"] for row in range(3)] == [False, True, False]
    for step, info, observation, total in ends.values():
        assert not np.array_equal(info["terminal_observation"], observation)
        assert info["episode"]["l"] == step
        assert info["episode"]["r"] == pytest.approx(total)


def test_a_seed_decides_the_next_reset(make):
    env = make()
    firsts = []
    for seed in (1, 2, 1):
        assert env.seed(seed) == [seed] * NUM_ENVS
        firsts.append(env.reset())
    assert np.array_equal(firsts[0], firsts[2])
    assert not np.array_equal(firsts[0], firsts[1])


def test_attributes_and_methods_are_those_of_the_one_environment(make):
    env = make()
    assert env.get_attr("num_envs", [0, 2]) == [NUM_ENVS, NUM_ENVS]
    assert len(env.get_attr("num_envs")) == NUM_ENVS
    env.set_attr("note", 7)
    assert env.env.note == 7
    assert env.env_method("get_observations", indices=0)[0]["actor"].shape == (NUM_ENVS, 5)
    assert env.env_is_wrapped(VecNormalize) == [False] * NUM_ENVS
    # Infos have the returns that SB3 reads from a `Monitor`.
    assert env.env_is_wrapped(Monitor, [0]) == [True]


def test_evaluations_read_the_returns_of_episodes(make, recwarn):
    env = VecNormalize(make(), norm_reward=True)
    model = PPO("MlpPolicy", env, device="cpu", seed=1, n_steps=8, batch_size=24)
    recwarn.clear()
    returns, lengths = evaluate_policy(model, env, n_eval_episodes=6, return_episode_rewards=True)
    assert not [warning for warning in recwarn if "Monitor" in str(warning.message)]
    assert sorted(set(lengths)) == [3, 4, 5]
    # Not the normalized rewards.
    assert all(value > 0.0 for value in returns)


@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_images_are_one_for_each_environment(render_mode):
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.viewer.width, cfg.viewer.height = NUM_ENVS, 32, 24
    try:
        env = Sb3VecEnv(ManagerBasedRlEnv(cfg, "cpu", render_mode))
        env.reset()
        images = env.get_images()
        assert len(images) == NUM_ENVS
        if render_mode is None:
            assert images == [None] * NUM_ENVS
        else:
            assert [image.shape for image in images] == [(24, 32, 3)] * NUM_ENVS
            # Tiled, 2 x 2.
            assert env.render().shape == (48, 64, 3)
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
    finally:
        env.close()


@pytest.mark.parametrize(
    ("learner", "group", "policy"),
    [(PPO, "actor", "MlpPolicy"), (PPO, None, "MultiInputPolicy"), (SAC, "actor", "MlpPolicy")],
)
def test_its_learners_take_it(make, learner, group, policy):
    env = VecNormalize(make(group=group, clip_actions=1.0))
    settings = {"n_steps": 8, "batch_size": 24} if learner is PPO else {"learning_starts": 6}
    model = learner(policy, env, device="cpu", seed=1, **settings)
    model.learn(60)
    assert len(model.ep_info_buffer) > 0


def test_without_auto_reset_there_is_no_such_environment(make):
    with pytest.raises(ValueError, match="auto_reset: expected True, got False"):
        make(auto_reset=False)
