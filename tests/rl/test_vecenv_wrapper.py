"""The wrapper: bootstrapping of time-outs, shared buffers, clipping."""

from __future__ import annotations

import pytest
import torch
from rl_fake_env import FakeEnv, FakeEnvCfg, FakeSceneCfg

from mjlab.rl import RslRlVecEnvWrapper


def wrapped(clip_actions=None, num_envs=3, **cfg) -> RslRlVecEnvWrapper:
    env = FakeEnv(FakeEnvCfg(scene=FakeSceneCfg(num_envs=num_envs), **cfg))
    if clip_actions is not None:
        from mjlab.utils import spaces

        env.single_action_space = spaces.Box(shape=(2,))
    return RslRlVecEnvWrapper(env, clip_actions=clip_actions)


def test_the_environment_is_reset_once_and_observations_are_a_tensordict():
    env = wrapped()
    observations = env.get_observations()
    assert observations.batch_size == (3,)
    assert observations["actor"].shape == (3, 2)
    assert observations["critic"].shape == (3, 4)
    assert observations["actor"].abs().sum() > 0


def test_dones_are_integers_and_only_pure_time_outs_are_marked():
    env = wrapped()
    fake = env.unwrapped
    # Environment 0 runs out of time, 1 terminates, 2 does both in one step.
    fake.position = torch.tensor([[0.0, 0.0], [9.0, 9.0], [9.0, 9.0]])
    fake.episode_length_buf.copy_(torch.tensor([11, 0, 11]))
    _, _, dones, extras = env.step(torch.zeros(3, 2))
    assert dones.dtype == torch.int64
    assert dones.tolist() == [1, 1, 1]
    assert extras["time_outs"].tolist() == [True, False, False]


def test_a_finite_horizon_is_not_bootstrapped():
    _, _, _, extras = wrapped(is_finite_horizon=True).step(torch.zeros(3, 2))
    assert "time_outs" not in extras


def test_time_outs_add_the_discounted_value_to_the_reward(make_runner):
    runner = make_runner(num_envs=2)
    fake = runner.env.unwrapped
    fake.episode_length_buf.copy_(torch.tensor([11, 0]))
    fake.position = torch.zeros(2, 2)
    alg = runner.alg
    with torch.inference_mode():
        observations = runner.env.get_observations()
        actions = alg.act(observations)
        values = alg.transition.values.clone()
        observations, rewards, dones, extras = runner.env.step(actions)
        alg.process_env_step(observations, rewards, dones, extras)
    stored = alg.storage.rewards[0, :, 0]
    assert dones.tolist() == [1, 0]
    assert torch.allclose(stored[0], rewards[0] + 0.99 * values[0, 0])
    assert values[0, 0] != 0.0
    assert torch.equal(stored[1], rewards[1])


def test_assigning_episode_lengths_keeps_the_tensor():
    env = wrapped()
    before = env.unwrapped.episode_length_buf
    env.episode_length_buf = torch.tensor([1, 2, 3])
    assert env.unwrapped.episode_length_buf is before
    assert before.tolist() == [1, 2, 3]


def test_actions_are_clipped_before_the_environment_sees_them():
    env = wrapped(clip_actions=0.5)
    given = torch.tensor([[2.0, -2.0], [0.1, 0.2], [0.0, 0.6]])
    env.step(given)
    assert env.unwrapped.seen_actions.tolist() == given.clamp(-0.5, 0.5).tolist()
    assert given[0, 0] == 2.0
    for space in (env.unwrapped.single_action_space, env.action_space):
        assert (space.low, space.high) == (-0.5, 0.5)
    assert env.action_space.shape == (3, 2)


@pytest.mark.parametrize("clip", [0.0, -1.0])
def test_a_clip_of_everything_warns(clip):
    with pytest.warns(UserWarning, match=f"clip_actions.*{clip}"):
        env = wrapped(clip_actions=clip)
    # As `torch.clamp` with exchanged bounds.
    env.step(torch.rand(3, 2))
    assert env.unwrapped.seen_actions.unique().tolist() == [clip]


def test_attributes_are_those_of_the_environment():
    env = wrapped()
    assert env.num_actions == 2
    assert env.max_episode_length == 12
    assert env.device == torch.device("cpu")
    assert env.cfg is env.unwrapped.cfg
    assert env.class_name() == "RslRlVecEnvWrapper"
    env.close()
    assert env.unwrapped.closed
