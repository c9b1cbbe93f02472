"""Evaluation of a policy."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
import torch
from rl_fake_env import FakeEnv, FakeEnvCfg, FakeSceneCfg

from mjlab.rl import RslRlVecEnvWrapper, evaluation
from mjlab.rl.evaluation import (
    Bound,
    Episodes,
    EvaluationResult,
    episodes_to_show,
    evaluate_policy,
    make_evaluation_env,
    mean_and_interval,
    ratio_and_interval,
    summarize,
    wilson_interval,
)

# 97.5 % of Student's t with three degrees of freedom, from a printed table.
T95_OF_FOUR = 3.182446


class CountingEnv(FakeEnv):
    """Environment i ends its k-th episode after i + k steps; a step's reward is its number."""

    def reset(self):
        self.episode = torch.ones(self.num_envs, dtype=torch.long)
        self.episode_length_buf[:] = 0
        return self.get_observations(), {}

    def step(self, action):
        self.episode_length_buf += 1
        reward = self.episode_length_buf * self.step_dt
        done = self.episode_length_buf >= torch.arange(self.num_envs) + self.episode
        self.episode += done
        self.episode_length_buf[done] = 0
        return self.get_observations(), reward, done, torch.zeros_like(done), {"log": {}}


def counting(num_envs: int = 4, **cfg) -> RslRlVecEnvWrapper:
    scene = FakeSceneCfg(num_envs=num_envs)
    return RslRlVecEnvWrapper(CountingEnv(FakeEnvCfg(scene=scene, episode_steps=20, **cfg)))


def still(observations) -> torch.Tensor:
    return torch.zeros(observations["actor"].shape[0], 2)


def test_each_environment_is_scored_on_its_first_episode_only():
    result = evaluate_policy(counting(), still)
    # First episodes have 1, 2, 3, 4 steps, with returns 1, 1+2, 1+2+3, 1+2+3+4; the shorter ones
    # are followed by others that must not count.
    assert result.returns == (1.0, 3.0, 6.0, 10.0)
    assert result.num_episodes == 4
    assert result.mean_return == 5.0
    assert result.mean_length == 2.5
    assert (result.min_return, result.max_return) == (1.0, 10.0)
    half = T95_OF_FOUR * result.std_return / math.sqrt(4)
    assert result.return_interval == pytest.approx((5.0 - half, 5.0 + half))
    assert result.success_rate is None
    assert result.num_unfinished == 0


def test_progress_counts_finished_episodes_over_all_rounds(monkeypatch):
    monkeypatch.setattr(evaluation, "_STEPS_BETWEEN_CHECKS", 1)
    told = []
    evaluate_policy(counting(), still, 6, progress=lambda *progress: told.append(progress))
    # First episodes have 1, 2, 3, 4 steps; the second round has two of them.
    assert [done for done, _ in told] == [1, 2, 3, 4, 5, 6]
    fractions = [fraction for _, fraction in told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert 1 / 6 < fractions[0] < 0.5


def test_returns_are_before_scaling_by_the_step():
    scaled, plain = counting(), counting(scale_rewards_by_dt=False)
    assert evaluate_policy(scaled, still).mean_return == 5.0
    assert evaluate_policy(plain, still).mean_return == 2.5


def test_the_state_is_restored_after_an_evaluation_that_fails():
    env = counting()
    state = {"episode": 3}
    env.unwrapped.state_dict = lambda: dict(state)
    env.unwrapped.load_state_dict = state.update

    def fails(observations):
        state["episode"] = 5
        raise RuntimeError("no more actions")

    with pytest.raises(RuntimeError, match="no more actions"):
        evaluate_policy(env, fails)
    assert state == {"episode": 3}


def test_episodes_take_as_many_rounds_as_needed():
    assert evaluate_policy(counting(), still, 6).returns == (1.0, 3.0, 6.0, 10.0, 1.0, 3.0)
    assert evaluate_policy(counting(), still, 2).returns == (1.0, 3.0)


def test_episodes_are_cut_off_and_counted_as_unfinished():
    result = evaluate_policy(counting(), still, max_steps=3)
    assert result.returns == (1.0, 3.0, 6.0, 6.0)
    assert result.num_unfinished == 1
    assert "1 of 4 episodes were truncated" in result.notes[0]
    assert result.to_dict()["notes"] == list(result.notes)


def test_figures_are_read_back():
    metrics = {"one": lambda env: torch.ones(4)}
    result = evaluate_policy(counting(), still, success="survival", metrics=metrics)
    again = EvaluationResult.from_dict({"task": "counting", **result.to_dict()})
    assert again == dataclasses.replace(result, returns=())
    assert again.judged("failure_rate") == result.judged("failure_rate")


@pytest.mark.parametrize(
    "success",
    [
        {"success": "survival"},
        {"success": 0.5},
        {"success": lambda env: torch.ones(4, dtype=torch.bool)},
    ],
    ids=lambda success: next(iter(success)),
)
def test_an_unfinished_episode_is_no_success(success):
    assert evaluate_policy(counting(), still, **success).success_rate == 1.0
    assert evaluate_policy(counting(), still, max_steps=3, **success).success_rate == 0.75


def test_an_episode_of_the_full_length_is_finished_without_a_time_out():
    env = counting()
    env.max_episode_length = 3
    result = evaluate_policy(env, still, success=0.5)
    assert result.returns == (1.0, 3.0, 6.0, 6.0)
    assert (result.num_unfinished, result.success_rate) == (0, 1.0)


def test_one_episode_has_no_interval_and_says_so():
    env = counting(num_envs=1)
    result = evaluate_policy(env, still, metrics={"one": lambda env: torch.ones(1)})
    assert result.return_interval is result.std_return is result.metrics["one"].interval is None
    assert "one episode has no confidence interval" in " ".join(result.notes)
    assert json.loads(result.to_json())["return_interval"] is None


@pytest.mark.parametrize("count", [2, 5, 30])
def test_intervals_of_the_mean_contain_it_95_times_in_100(count):
    generator = torch.Generator().manual_seed(0)
    samples = torch.randn(4000, count, generator=generator, dtype=torch.float64)
    intervals = [mean_and_interval(sample).interval for sample in samples]
    covered = [low <= 0.0 <= high for low, high in intervals]
    # Three standard errors of the count.
    assert sum(covered) / 4000 == pytest.approx(0.95, abs=3 * math.sqrt(0.95 * 0.05 / 4000))


def test_few_episodes_come_with_a_warning_of_rare_failures():
    assert "rare failures" in evaluate_policy(counting(199), still).notes[0]
    assert evaluate_policy(counting(200), still).notes == ()


def rates(failures: int, episodes: int) -> EvaluationResult:
    failed = torch.arange(episodes) < failures
    played = Episodes(
        returns=torch.zeros(episodes),
        lengths=torch.ones(episodes),
        finished=torch.ones_like(failed),
        failed=failed,
        succeeded=~failed,
        terminations={},
        metrics={},
        standing_still={},
    )
    return summarize(played, played.succeeded, 0.0)


def test_bounds_judge_rates_by_the_middle_of_their_interval():
    for failures, episodes in ((0, 4), (8, 200), (100, 200), (200, 200)):
        result = rates(failures, episodes)
        assert result.judged("failure_rate") == pytest.approx(sum(result.failure_interval) / 2)
        assert result.judged("success_rate") == pytest.approx(1 - result.judged("failure_rate"))
        assert result.judged("mean_length") == result.value("mean_length")
    assert rates(0, 4).judged("failure_rate") > 0.2
    assert rates(8, 200).judged("failure_rate") < 0.05 < rates(9, 200).judged("failure_rate")


@pytest.mark.parametrize("rate", [0.01, 0.05, 0.2, 0.3])
def test_episodes_needed_for_a_failure_rate(rate):
    needed = episodes_to_show(rate)
    assert rates(0, needed).judged("failure_rate") <= rate
    assert rates(0, needed - 1).judged("failure_rate") > rate


def test_success_is_by_return_or_by_function():
    result = evaluate_policy(counting(), still, success=6.0)
    assert result.success_rate == 0.5
    assert result.success_interval == wilson_interval(0.5, 4)
    # The function is asked before each step, so the last answer is that of the terminal state's
    # predecessor: environment i has made i steps then.
    by_function = evaluate_policy(
        counting(), still, success=lambda env: env.episode_length_buf >= 3
    )
    assert by_function.success_rate == 0.25
    by_name = evaluate_policy(counting(), still, success=f"{__name__}:made_three_steps")
    assert by_name.success_rate == 0.25
    with pytest.raises(ValueError, match="expected a return, `survival` or"):
        evaluate_policy(counting(), still, success="survived")


def made_three_steps(env):
    return env.episode_length_buf >= 3


def test_metrics_average_steps_then_episodes():
    # Before its steps environment i has seen 0, ..., i steps, which is i/2 on average.
    result = evaluate_policy(
        counting(), still, metrics={"steps": lambda env: env.episode_length_buf.float()}
    )
    steps = result.metrics["steps"]
    assert steps.mean == 0.75
    half = T95_OF_FOUR * torch.tensor([0.0, 0.5, 1.0, 1.5]).std().item() / 2
    assert steps.interval == pytest.approx((0.75 - half, 0.75 + half))
    assert result.to_dict()["metrics"]["steps"]["mean"] == 0.75


def test_metrics_are_given_as_shares_of_those_of_standing_still():
    error = {"error": lambda env: torch.where(env.episode_length_buf == 0, 1.0, 2.0)}
    still_error = {"error": lambda env: torch.full((4,), 4.0)}
    result = evaluate_policy(counting(), still, metrics=error, standing_still=still_error)
    share = result.metrics["error_share"]
    assert share.mean == pytest.approx(result.metrics["error"].mean / 4.0)
    assert share.interval == pytest.approx([x / 4.0 for x in result.metrics["error"].interval])
    assert result.value("error_share") == share.mean
    assert result.to_dict()["standing_still"] == {"error": 4.0}
    with pytest.raises(ValueError, match="standing_still"):
        evaluate_policy(counting(), still, standing_still=still_error)


def test_no_share_of_an_error_of_zero():
    zeros = {"error": lambda env: torch.zeros(4)}
    ones = {"error": lambda env: torch.ones(4)}
    result = evaluate_policy(counting(), still, metrics=ones, standing_still=zeros)
    assert set(result.metrics) == {"error"}
    assert math.isnan(result.value("error_share"))
    assert not Bound("error_share", 0.5, is_upper=True).is_met(result)
    json.loads(result.to_json(), parse_constant=pytest.fail)


def test_share_is_a_ratio_of_means():
    errors, references = torch.tensor([1.0, 0.0, 5.0]), torch.tensor([0.0, 2.0, 10.0])
    found = ratio_and_interval(errors, references)
    assert found.mean == pytest.approx(0.5)
    # Errors that are that share of their references in each episode leave no doubt.
    exact = ratio_and_interval(0.3 * references, references)
    assert exact.interval == pytest.approx((0.3, 0.3))
    assert found.interval[1] - found.interval[0] > 0.1


def test_a_metric_that_is_infinite_after_the_episode_does_not_reach_it():
    def blow_up(env):
        first_episode = env.episode == 1
        return torch.where(first_episode, 1.0, torch.inf)

    assert evaluate_policy(counting(), still, metrics={"x": blow_up}).metrics["x"].mean == 1.0


def test_failures_are_episodes_that_a_termination_ended():
    class Failing(CountingEnv):
        def step(self, action):
            *rest, done, truncated, extras = super().step(action)
            # The first and the last environment fail; the others run out of time.
            self.reset_terminated = done & torch.tensor([True, False, False, True])
            return *rest, self.reset_terminated, done & ~self.reset_terminated, extras

    env = RslRlVecEnvWrapper(Failing(FakeEnvCfg(scene=FakeSceneCfg(num_envs=4), episode_steps=20)))
    result = evaluate_policy(env, still)
    assert result.failure_rate == 0.5
    assert result.failure_interval == wilson_interval(0.5, 4)
    assert evaluate_policy(counting(), still).failure_rate == 0.0


def test_a_figure_is_found_by_name_and_an_unknown_one_is_refused():
    result = evaluate_policy(counting(), still, metrics={"one": lambda env: torch.ones(4)})
    assert result.value("one") == 1.0
    assert result.value("mean_return") == 5.0
    with pytest.raises(ValueError, match="'two'.*'one', 'mean_return', 'mean_length'"):
        result.value("two")
    with pytest.raises(ValueError, match="'success_rate'"):
        result.value("success_rate")


def test_json_has_the_figures_without_the_single_returns():
    values = json.loads(evaluate_policy(counting(), still, success=6.0).to_json())
    assert values["mean_return"] == 5.0
    assert values["success_rate"] == 0.5
    assert len(values["return_interval"]) == 2
    assert "returns" not in values


def test_the_same_seed_gives_the_same_figures():
    env = RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg(seed=None)))
    one = evaluate_policy(env, still, seed=3)
    assert evaluate_policy(env, still, seed=3).returns == one.returns
    assert evaluate_policy(env, still, seed=4).returns != one.returns


class RememberingEnv(FakeEnv):
    """A counter that survives resets makes every episode worth more than the one before."""

    starts = 0

    def _start_episodes(self, mask):
        self.starts += 1
        super()._start_episodes(mask)

    def step(self, action):
        observations, reward, *rest = super().step(action)
        return observations, reward + self.starts, *rest

    def state_dict(self):
        return {**super().state_dict(), "starts": self.starts}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.starts = state["starts"]


def test_what_outlives_a_reset_does_not_reach_the_next_evaluation():
    env = RslRlVecEnvWrapper(RememberingEnv(FakeEnvCfg()))
    counter = env.unwrapped.common_step_counter = 50
    one = evaluate_policy(env, still, 20, seed=3)
    assert evaluate_policy(env, still, 20, seed=3).returns == one.returns
    assert env.unwrapped.common_step_counter == counter


def test_unfit_states_are_evaluated_with_a_warning(caplog):
    class Refusing(FakeEnv):
        def load_state_dict(self, state):
            raise ValueError("It changed its size.")

    evaluate_policy(RslRlVecEnvWrapper(Refusing(FakeEnvCfg())), still)
    assert "another evaluation in them may differ. It changed its size." in caplog.text


def test_a_policy_with_memory_is_reset_with_its_environments():
    class Memory:
        def __init__(self):
            self.calls = []

        def __call__(self, observations):
            return still(observations)

        def reset(self, dones=None):
            self.calls.append(None if dones is None else dones.tolist())

    policy = Memory()
    evaluate_policy(counting(2), policy)
    assert policy.calls[:3] == [None, [1, 0], [0, 1]]


def test_endless_episodes_and_no_episodes_are_refused():
    endless = RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg(episode_steps=10**9)))
    with pytest.raises(ValueError, match="max_steps: .*episode_length_s"):
        evaluate_policy(endless, still)
    with pytest.raises(ValueError, match="num_episodes.*got 0"):
        evaluate_policy(counting(), still, 0)
    with pytest.raises(ValueError, match="max_steps.*got 0"):
        evaluate_policy(counting(), still, max_steps=0)


@pytest.mark.parametrize("rate", [0.0, 0.25, 1.0])
def test_the_interval_of_a_rate_is_within_bounds_and_shrinks(rate):
    few, many = wilson_interval(rate, 10), wilson_interval(rate, 1000)
    for low, high in (few, many):
        assert 0.0 <= low <= rate <= high <= 1.0
        assert low < high
    assert many[1] - many[0] < few[1] - few[0]


def test_an_environment_beside_another_leaves_it_and_the_generators_alone():
    env = RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg()))
    generators, position = torch.get_rng_state(), env.unwrapped.position.clone()
    beside = make_evaluation_env(env, 5, seed=9)
    assert beside.num_envs == 5
    assert beside.cfg.seed == 9
    assert env.num_envs == 8
    assert env.cfg.seed == 0
    assert torch.equal(torch.get_rng_state(), generators)
    assert torch.equal(env.unwrapped.position, position)
