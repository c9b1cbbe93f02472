"""Rewards and terminations that are NaN or infinite: counted, named once, and an end of training."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import RewardTermCfg, TerminationTermCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.rollout_watch import BrokenTermError
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

NUM_ENVS, STEPS = 4, 20
NAN = float("nan")


@pytest.fixture
def make_env() -> Iterator[Any]:
    made = []

    def make(**terms: Any) -> ManagerBasedRlEnv:
        """Make environments with a term `mine`, a reward or a termination."""
        cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
        cfg.scene.num_envs, cfg.seed = NUM_ENVS, 5
        for kind, func in terms.items():
            if kind == "reward":
                cfg.rewards["mine"] = RewardTermCfg(func=func, weight=2.0)
            else:
                cfg.terminations["mine"] = TerminationTermCfg(func=func)
        made.append(ManagerBasedRlEnv(cfg, device="cpu"))
        made[-1].reset()
        return made[-1]

    yield make
    for env in made:
        env.close()


def learn(env: ManagerBasedRlEnv, folder: Any, iterations: int = 2) -> None:
    from dataclasses import asdict

    cfg = load_rl_cfg("Mjlab-Cartpole-Swingup")
    cfg.num_steps_per_env = STEPS
    train_cfg = asdict(cfg) | {"evaluation": {}}
    MjlabOnPolicyRunner(RslRlVecEnvWrapper(env), train_cfg, str(folder), "cpu").learn(iterations)


def everywhere(value: float) -> Any:
    return lambda env: torch.full((env.num_envs,), value)


def first_environment(env: Any) -> torch.Tensor:
    value = torch.ones(env.num_envs)
    value[0] = torch.nan if env.common_step_counter % 2 else 1.0
    return value


def messages(caplog: Any, part: str) -> list[str]:
    return [record.getMessage() for record in caplog.records if part in record.getMessage()]


@pytest.mark.parametrize(
    ("kind", "value"),
    [("reward", NAN), ("reward", float("inf")), ("termination", NAN), ("termination", 0.5)],
)
def test_a_term_that_stays_broken_everywhere_ends_training_by_name(make_env, tmp_path, kind, value):
    with pytest.raises(BrokenTermError, match="term 'mine'"):
        learn(make_env(**{kind: everywhere(value)}), tmp_path)


def test_a_reward_that_is_broken_at_times_is_named_once_and_counted(make_env, tmp_path, caplog):
    learn(make_env(reward=first_environment), tmp_path)
    (told,) = messages(caplog, "NaN or infinite")
    for part in ("'mine'", f"1 of {NUM_ENVS}", "step 1"):
        assert part in told
    events = EventAccumulator(str(tmp_path)).Reload()
    counts = [event.value for event in events.Scalars("Simulation/nan_rewards")]
    assert counts == [pytest.approx(0.5)] * 2


def test_a_term_that_recovers_does_not_end_training(make_env, tmp_path):
    def mostly(env: Any) -> torch.Tensor:
        finite = env.common_step_counter % STEPS == 3
        return torch.full((env.num_envs,), 1.0 if finite else NAN)

    learn(make_env(reward=mostly), tmp_path)


def test_a_termination_that_returns_floats_is_named_once(make_env, caplog):
    env = make_env(termination=lambda env: (env.episode_length_buf >= 3).float())
    ends = [env.step(torch.zeros(NUM_ENVS, 1))[2].all().item() for _ in range(6)]
    assert ends == [False, False, True] * 2
    (message,) = messages(caplog, "float32")
    assert "'mine'" in message
    assert "expected bool" in message


def test_environments_that_diverged_are_not_blamed_on_terms(make_env, caplog):
    env = make_env(reward=lambda env: env.sim.data.qvel[:, 0])
    env.sim.data.qvel[1] = NAN
    _, reward, *_, extras = env.step(torch.zeros(NUM_ENVS, 1))
    assert extras["log"]["Simulation/nan_rewards"] == 0
    assert reward[1] == 0
    assert not messages(caplog, "NaN or infinite")


@pytest.mark.parametrize("first", [True, False])
def test_steps_in_and_out_of_inference_mode_may_follow_each_other(make_env, first):
    def broken_once(env: Any) -> torch.Tensor:
        return torch.full((env.num_envs,), NAN if env.common_step_counter == 1 else 1.0)

    env = make_env(reward=broken_once, termination=lambda env: torch.zeros(env.num_envs))
    for inference in (first, not first, first, not first):
        with torch.inference_mode(inference):
            env.step(torch.zeros(NUM_ENVS, 1))


def test_a_broken_term_is_not_told_as_diverged_physics(make_env, tmp_path):
    env = make_env(reward=everywhere(NAN))
    # Too fast for a time step to resolve, and not bad to MuJoCo.
    env.sim.data.qvel[:, 1] = 1e4
    with pytest.raises(BrokenTermError, match="term 'mine'"):
        learn(env, tmp_path)


def test_training_stops_when_every_action_is_bad(make_env, tmp_path):
    env = make_env()
    process = env.action_manager.process_action
    env.action_manager.process_action = lambda action: process(action * NAN)
    with pytest.raises(BrokenTermError, match="Action was NaN .*20 steps.*policy"):
        learn(env, tmp_path)
