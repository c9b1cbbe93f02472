"""Bootstrapped values at time-outs: those of the final observations."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest
import torch
from rl_fake_env import FakeEnv, FakeEnvCfg, FakeSceneCfg, runner_cfg

from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.config import RslRlModelCfg

NUM_ENVS, STEPS = 8, 5
GAMMA = 0.99


class ObservingEnv(FakeEnv):
    """Fake environment that can return the final observations of episodes that time out."""

    observes_ends = False

    def step(self, action: torch.Tensor):
        *returned, extras = super().step(action)
        terminated, truncated = returned[2:4]
        ids = (truncated & ~terminated).nonzero().flatten()
        if self.observes_ends and len(ids) > 0:
            extras["final_ids"] = ids
            extras["final_observations"] = {k: v[ids] for k, v in self._ended.items()}
        return (*returned, extras)

    def _start_episodes(self, mask: torch.Tensor) -> None:
        self._ended = self.get_observations()
        super()._start_episodes(mask)


def make_runner(env_cls: type[FakeEnv] = ObservingEnv, **changes: Any) -> MjlabOnPolicyRunner:
    env_changes = {key: changes.pop(key) for key in ("is_finite_horizon",) if key in changes}
    env = env_cls(FakeEnvCfg(scene=FakeSceneCfg(num_envs=NUM_ENVS), episode_steps=4, **env_changes))
    return MjlabOnPolicyRunner(RslRlVecEnvWrapper(env), runner_cfg(**changes))


class Log:
    """Record of what environment, critic and storage exchange in each step of `learn(1)`."""

    def __init__(self, runner: MjlabOnPolicyRunner) -> None:
        self.steps: list[tuple[torch.Tensor, torch.Tensor, dict[str, Any]]] = []
        self.before: list[Any] = []
        self.logged: list[torch.Tensor] = []
        self.runner = runner
        self._step, self._act = runner.env.step, runner.alg.act
        runner.env.step, runner.alg.act = self.step, self.act
        process = runner.logger.process_env_step

        def log(rewards: torch.Tensor, *args: Any) -> None:
            self.logged.append(rewards.clone())
            process(rewards, *args)

        runner.logger.process_env_step = log
        # The weights used for data collection.
        runner.alg.update = self.look

    def act(self, observations: Any) -> torch.Tensor:
        actions = self._act(observations)
        self.before.append(self.runner.alg.transition.values[:, 0].clone())
        return actions

    def step(self, actions: torch.Tensor) -> Any:
        returned = self._step(actions)
        state = self.runner.alg.critic.get_hidden_state()
        # The memory of environments that are done is cleared in place.
        state = None if state is None else state.clone()
        self.steps.append((returned[1].clone(), state, dict(returned[3])))
        return returned

    def look(self) -> dict[str, float]:
        self.stored = self.runner.alg.storage.rewards[..., 0].clone()
        return {}


def expected(log: Log, value_of: Any) -> torch.Tensor:
    """Return the rewards (steps, N) that PPO should store."""
    rewards = torch.stack([reward for reward, *_ in log.steps])
    for row, (_, state, extras) in zip(rewards, log.steps, strict=True):
        if "final_ids" in extras:
            row[extras["final_ids"]] += GAMMA * value_of(extras, state)
    return rewards


def test_ppo_bootstraps_from_final_observations():
    runner = make_runner()
    log = Log(runner)
    runner.learn(1)

    def value_of(extras: dict[str, Any], _: Any) -> torch.Tensor:
        return runner.alg.critic(extras["final_observations"])[:, 0].detach()

    ids = [extras["final_ids"] for *_, extras in log.steps if "final_ids" in extras]
    assert len(torch.cat(ids)) >= NUM_ENVS // 2
    assert torch.allclose(log.stored, expected(log, value_of), atol=1e-6)
    # Episodes are scored by what the environment gave.
    assert torch.equal(torch.stack(log.logged), torch.stack([reward for reward, *_ in log.steps]))


def test_a_recurrent_critic_values_it_by_what_it_remembers_of_the_episode():
    rnn = {"class_name": "RNNModel", "rnn_type": "gru", "rnn_hidden_dim": 8}
    critic = {**asdict(RslRlModelCfg(hidden_dims=(8,))), **rnn}
    runner = make_runner(critic=critic)
    log = Log(runner)
    runner.learn(1)
    model = runner.alg.critic
    # The memory is as if the critic had not been asked.
    model.reset()
    storage = runner.alg.storage
    for step in range(STEPS):
        assert torch.allclose(model(storage.observations[step]), storage.values[step], atol=1e-6)
        model.reset(storage.dones[step, :, 0])

    def value_of(extras: dict[str, Any], state: torch.Tensor) -> torch.Tensor:
        model.reset(hidden_state=state[:, extras["final_ids"]])
        return model(extras["final_observations"])[:, 0].detach()

    assert any("final_ids" in extras for *_, extras in log.steps)
    assert torch.allclose(log.stored, expected(log, value_of), atol=1e-6)


def test_without_final_observations_the_value_before_the_step_stands_in():
    runner = make_runner(FakeEnv)
    log = Log(runner)
    runner.learn(1)
    rewards = torch.stack([reward for reward, *_ in log.steps])
    time_outs = torch.stack([extras["time_outs"] for *_, extras in log.steps])
    assert time_outs.any()
    assert torch.allclose(log.stored, rewards + GAMMA * time_outs * torch.stack(log.before))


def test_only_learning_asks_for_them_and_not_with_a_finite_horizon():
    runner = make_runner()
    env = runner.env.unwrapped
    runner.evaluate()
    assert not env.observes_ends
    runner.learn(1)
    assert env.observes_ends
    runner = make_runner(is_finite_horizon=True)
    runner.learn(1)
    assert not runner.env.unwrapped.observes_ends


@pytest.mark.parametrize("declares", [False, True])
def test_an_algorithm_that_takes_them_itself_gets_them_untouched(monkeypatch, declares):
    import mjlab.rl.runner as module

    runner = make_runner()
    # Seen as an algorithm of another kind.
    monkeypatch.setattr(module, "PPO", type("Other", (), {}))
    runner.alg.takes_final_observations = declares
    given = []
    process = runner.alg.process_env_step

    def note(observations: Any, rewards: torch.Tensor, dones: Any, extras: dict[str, Any]) -> None:
        given.append((rewards, extras))
        process(observations, rewards, dones, extras)

    runner.alg.process_env_step = note
    log = Log(runner)
    runner.learn(1)
    assert runner.env.unwrapped.observes_ends == declares
    assert any("final_observations" in extras for _, extras in given) == declares
    for (rewards, extras), (reward, _, returned) in zip(given, log.steps, strict=True):
        assert torch.equal(rewards, reward)
        assert extras.keys() == returned.keys()
        assert torch.equal(extras["time_outs"], returned["time_outs"])


def test_they_are_a_tensordict_of_the_environments_that_ran_out_of_time():
    env = RslRlVecEnvWrapper(ObservingEnv(FakeEnvCfg(scene=FakeSceneCfg(num_envs=3))))
    env.observe_ends()
    env.unwrapped.position = torch.zeros(3, 2)
    env.episode_length_buf = torch.tensor([11, 0, 11])
    extras = env.step(torch.zeros(3, 2))[3]
    assert extras["final_observations"].batch_size == (2,)
    assert extras["final_observations"]["critic"].shape == (2, 4)
    env.observe_ends(False)
    env.episode_length_buf = torch.tensor([11, 0, 11])
    assert "final_observations" not in env.step(torch.zeros(3, 2))[3]
