"""Environments as skrl sees them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch

pytest.importorskip("skrl")

from example_files import load_example
from rl_ending_env import ending_env
from skrl.agents.torch import Agent

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl.skrl import SkrlEnv, with_final_observations

NUM_ENVS = 3


def make_env(auto_reset: bool = True) -> ManagerBasedRlEnv:
    """Return environments; number 2 times out in the step in which it terminates."""
    return ending_env(failed=[2, 99, 4], time_out=[99, 3, 4], auto_reset=auto_reset)


@pytest.fixture
def env() -> Iterator[SkrlEnv]:
    env = SkrlEnv(make_env(), state_group="critic")
    yield env
    env.close()


def test_results_are_columns_and_states_those_of_the_critic(env):
    observations, _ = env.reset()
    assert torch.equal(env.reset()[0], observations)
    assert torch.equal(env.state(), env.unwrapped.get_observations()["critic"])
    assert env.observation_space.shape == env.state_space.shape == (5,)
    for _ in range(3):
        last = env.step(torch.zeros(NUM_ENVS, 1))
    assert [value.shape for value in last[1:4]] == [(NUM_ENVS, 1)] * 3
    assert last[3].flatten().tolist() == [False, True, False]
    # A termination at the time limit has no future to bootstrap from. (Environment 0 fails again.)
    _, _, terminated, truncated, _ = env.step(torch.zeros(NUM_ENVS, 1))
    assert terminated.flatten().tolist() == [True, False, True]
    assert not truncated.any()


def test_agents_that_share_environments_are_refused(env):
    class Agent:
        def record_transition(self, **transition: Any) -> None: ...

    observations, *_, infos = (env.reset(), env.step(torch.zeros(NUM_ENVS, 1)))[1]
    agent = with_final_observations(Agent)()
    with pytest.raises(ValueError, match="expected one agent for all 3 environments, got 2"):
        agent.record_transition(next_observations=observations[:2], next_states=None, infos=infos)


def test_agents_record_what_episodes_ended_with(env):
    recorded = []

    class Recorder(Agent):
        def __init__(self) -> None: ...
        def act(self, *args: Any, **kwargs: Any) -> Any: ...
        def update(self, *args: Any, **kwargs: Any) -> None: ...
        def pre_interaction(self, *args: Any, **kwargs: Any) -> None: ...
        def post_interaction(self, *args: Any, **kwargs: Any) -> None: ...
        def record_transition(self, **transition: Any) -> None:
            recorded.append(transition)

    agent = with_final_observations(Recorder)()
    env.reset()
    for step in (1, 2, 3):
        returned, rewards, _, _, infos = env.step(torch.zeros(NUM_ENVS, 1))
        agent.record_transition(
            next_observations=returned, next_states=env.state(), infos=infos, rewards=rewards
        )
        differs = (recorded[-1]["next_observations"] != returned).any(dim=1)
        # Environments 0 and then 1 ended; what `step` returned is left alone.
        assert differs.nonzero().flatten().tolist() == {1: [], 2: [0], 3: [1]}[step]
        assert torch.equal(recorded[-1]["next_states"], recorded[-1]["next_observations"])


def test_without_auto_reset_there_is_no_such_environment():
    env = make_env(auto_reset=False)
    with pytest.raises(ValueError, match="auto_reset: expected True, got False"):
        SkrlEnv(env)
    env.close()


def test_its_learner_takes_it(tmp_path):
    example = load_example("skrl_swing_up")
    env = example.make_env(1, "cpu")
    trainer, policy = example.make_trainer(env, str(tmp_path))
    before = [parameter.clone() for parameter in policy.parameters()]
    for step in range(example.STEPS + 1):
        trainer.train(timestep=step, timesteps=100)
    assert not any(map(torch.equal, before, policy.parameters()))
    env.close()
