"""Solved check: conditions that stop training, episodes of evaluations, reports."""

from __future__ import annotations

import math
import signal
import statistics
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from rl_fake_env import FakeEnv, FakeEnvCfg, FakeSceneCfg, runner_cfg

from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.config import EvaluationCfg
from mjlab.rl.evaluation import SolvedCheck, episodes_to_show
from mjlab.rl.plot import DEFAULT_TAG, read_all_scalars, read_scalars
from mjlab.rl.run_logger import TrainingObserver

BOUND = 0.05
EPISODES = 200
# A seed whose first evaluation passes at 10 and 11 iterations by luck.
SEED = 6


class FailingEnv(FakeEnv):
    """Episodes of one step, which fail the less often the longer has been trained."""

    built: list[FailingEnv] = []

    def __init__(self, cfg: FakeEnvCfg, device: str = "cpu") -> None:
        super().__init__(cfg, device)
        self.seeds = [cfg.seed]
        self.built.append(self)

    def seed(self, seed: int = -1) -> int:  # ty: ignore[invalid-method-override]
        if hasattr(self, "seeds"):
            self.seeds.append(seed)
        return super().seed(seed)

    @property
    def rate(self) -> float:
        return 0.15 * math.exp(-self.common_step_counter / 50)

    def step(self, action):
        self.reset_terminated = torch.rand(self.num_envs) < self.rate
        failed = self.reset_terminated
        self.common_step_counter += 1
        return self.get_observations(), torch.ones(self.num_envs), failed, ~failed, {"log": {}}


@pytest.fixture(autouse=True)
def _no_env_yet(monkeypatch):
    monkeypatch.setattr(FailingEnv, "built", [])


def failing_env(seed: int) -> RslRlVecEnvWrapper:
    scene = FakeSceneCfg(num_envs=4)
    return RslRlVecEnvWrapper(FailingEnv(FakeEnvCfg(scene=scene, seed=seed, episode_steps=1)))


def evaluation(**changes) -> EvaluationCfg:
    values = {"solved_below": {"failure_rate": BOUND}, "min_interval": 1, "num_episodes": EPISODES}
    return EvaluationCfg(**{**values, **changes})


class Told(TrainingObserver):
    def __init__(self) -> None:
        self.told: list[tuple] = []

    def on_evaluation(self, iteration, result, solved):
        self.told.append(("evaluation", iteration, solved, result.failure_rate))

    def on_confirmation(self, iteration, result, solved):
        self.told.append(("confirmation", iteration, solved, result.failure_rate))


def learner(seed: int, log_dir: Path | None = None, **changes) -> tuple[MjlabOnPolicyRunner, Told]:
    cfg = runner_cfg(evaluation=asdict(evaluation(**changes)), seed=seed, save_interval=100)
    runner = MjlabOnPolicyRunner(failing_env(seed), cfg, None if log_dir is None else str(log_dir))
    told = Told()
    runner.observers.append(told)
    return runner, told


def test_training_stops_where_other_episodes_confirm_and_reports_those(tmp_path: Path):
    runner, told = learner(SEED, tmp_path / "run")
    runner.learn(100)
    assert runner.stop_reason == "solved"
    confirmations = [event for event in told.told if event[0] == "confirmation"]
    assert [solved for _, _, solved, _ in confirmations] == [False, False, True]
    met = [event[1] for event in told.told if event[0] == "evaluation" and event[2]]
    assert met == [iteration for _, iteration, _, _ in confirmations]
    assert runner.last_evaluation.failure_rate == confirmations[-1][3]
    assert confirmations[-1][3] != told.told[-2][3]
    # Written apart, so that the curve of the same episodes stays one.
    iterations, rates = read_scalars(tmp_path / "run", "Confirmation/failure_rate")
    assert list(iterations + 1) == [iteration for _, iteration, _, _ in confirmations]
    assert rates[-1] == pytest.approx(confirmations[-1][3])


def test_the_first_group_of_scalars_has_what_the_task_aims_at(tmp_path: Path):
    runner, _ = learner(SEED, tmp_path / "run")
    runner.learn(100)
    curves = read_all_scalars(tmp_path / "run")
    first = {tag: curve for tag, curve in curves.items() if tag.startswith("Aim/")}
    assert min(curves) in first
    assert first.keys() == {"Aim/exploring_return", "Aim/mean_return", "Aim/failure_rate"}
    for of, tag in (
        ("Aim/failure_rate", "Evaluation/failure_rate"),
        ("Aim/exploring_return", DEFAULT_TAG),
    ):
        assert first[of][1].tolist() == curves[tag][1].tolist()


def test_no_two_samples_share_a_seed_with_each_other_or_with_training():
    runner, told = learner(SEED)
    runner.learn(100)
    training, repeated, *fresh = FailingEnv.built
    assert len(fresh) == sum(name == "confirmation" for name, *_ in told.told) == 3
    assert len(set(repeated.seeds)) == 1
    # Built with its seed, and evaluated with it: other robots too, where they are randomized.
    seeds = [set(env.seeds) for env in (training, repeated, *fresh)]
    assert all(len(used) == 1 for used in seeds)
    assert len(set.union(*seeds)) == len(seeds)
    assert all(env.closed for env in fresh)


@pytest.mark.parametrize("stopped_at", [1, 11])
def test_a_resumed_run_evaluates_and_stops_as_the_uninterrupted_one(tmp_path: Path, stopped_at):
    whole, expected = learner(SEED)
    whole.learn(100)
    first, before = learner(SEED, tmp_path / "first")
    first.learn(stopped_at)
    second, after = learner(SEED)
    second.load(str(tmp_path / "first" / f"model_{stopped_at - 1}.pt"))
    second.learn(100)
    assert before.told + after.told == expected.told
    assert second.current_learning_iteration == whole.current_learning_iteration


class Stopping(TrainingObserver):
    """Stops training, as Ctrl-C does, at an iteration after which an evaluation is due."""

    def __init__(self, iteration: int) -> None:
        self._iteration = iteration

    def on_iteration(self, stats):
        if stats.iteration == self._iteration:
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(
    "remaining",
    [
        pytest.param(0, marks=pytest.mark.slow),
        1,
        pytest.param(5, marks=pytest.mark.slow),
    ],
)
def test_an_evaluation_left_out_by_a_stop_is_made_up_for(tmp_path: Path, remaining):
    """`remaining` iterations before the run is solved; with none, no more is trained."""
    whole, expected = learner(SEED)
    whole.learn(100)
    stopped_at = whole.current_learning_iteration - remaining
    first, before = learner(SEED, tmp_path / "first")
    first.observers.append(Stopping(stopped_at))
    first.learn(100)
    assert (first.stop_reason, first.current_learning_iteration) == ("interrupted", stopped_at)
    second, after = learner(SEED, tmp_path / "second")
    second.load(str(tmp_path / "first" / f"model_{stopped_at - 1}.pt"))
    second.learn(100)
    assert before.told + after.told == expected.told
    assert second.stop_reason == "solved"
    solved_at = whole.current_learning_iteration
    assert second.current_learning_iteration == solved_at
    assert (tmp_path / "second" / f"model_{solved_at - 1}.pt").is_file()
    # In one process it goes on in the same way.
    first.observers.pop()
    first.learn(100)
    assert before.told == expected.told


def test_endless_runs_are_evaluated_unconfirmed():
    runner, told = learner(SEED, stop_when_solved=False)
    runner.learn(15)
    assert runner.stop_reason == "finished"
    assert [(name, iteration) for name, iteration, _, _ in told.told] == [
        ("evaluation", iteration) for iteration in range(1, 16)
    ]
    assert told.told[-1][2]


def test_evaluations_wait_for_an_exploring_metric(tmp_path: Path):
    rates = {"rate": lambda env: torch.full((env.num_envs,), env.rate)}
    bound = {"rate": 0.1}
    runner, told = learner(
        SEED, tmp_path / "run", metrics=rates, trigger_below=bound, stop_when_solved=False
    )
    runner.learn(15)
    iterations, values = read_scalars(tmp_path / "run", "Train/rate")
    below = [int(it) + 1 for it, value in zip(iterations, values, strict=True) if value <= 0.1]
    assert 0 < len(below) < len(iterations)
    assert [iteration for _, iteration, _, _ in told.told] == below


def test_exploring_metrics_and_bounds_may_be_shares():
    cfg = evaluation(
        metrics={"rate": lambda env: torch.full((env.num_envs,), 0.1)},
        standing_still={"rate": lambda env: torch.full((env.num_envs,), 0.5)},
        trigger_below={"rate_share": 0.4},
        solved_below={"rate_share": 0.4},
    )
    exploring = SolvedCheck(failing_env(1), Still(), cfg, 1).exploring_metrics()
    assert exploring == {"rate_share": pytest.approx(0.2)}
    with pytest.raises(ValueError, match="rate_share"):
        SolvedCheck(failing_env(1), Still(), replace(cfg, standing_still={}), 1)


def test_an_unknown_exploring_metric_suggests_names():
    rates = {"rate": lambda env: torch.zeros(env.num_envs)}
    with pytest.raises(ValueError, match=r"trigger_below: 'rat'.*'rate'"):
        SolvedCheck(
            failing_env(1), Still(), evaluation(metrics=rates, trigger_below={"rat": 0.1}), 1
        )


class Still:
    """A policy, and the algorithm that holds it."""

    def __call__(self, observations):
        return torch.zeros(observations["actor"].shape[0], 2)

    def get_policy(self):
        return self

    def get_hidden_state(self):
        return None

    def reset(self, dones=None, hidden_state=None):
        pass

    def eval_mode(self):
        pass

    train_mode = eval_mode


def test_a_learner_that_was_lucky_is_found_out():
    """A learner that gets better slowly is tried often, so that luck stops it too early."""
    lucky, confirmed = [], []
    for seed in range(25):
        env = failing_env(seed)
        check = SolvedCheck(env, Still(), evaluation(), seed)
        for iteration in range(5, 100):
            env.unwrapped.common_step_counter = 5 * iteration
            if not check.is_solved_by(check.evaluate()):
                continue
            if len(lucky) == seed:
                lucky.append(env.unwrapped.rate)
            if check.is_solved_by(check.confirm(iteration)):
                confirmed.append(env.unwrapped.rate)
                break
    assert len(confirmed) == len(lucky) == 25
    assert sum(rate > BOUND for rate in lucky) >= 5
    assert sum(rate > BOUND for rate in confirmed) <= 2
    assert statistics.fmean(confirmed) < statistics.fmean(lucky) < BOUND


def test_bounds_that_so_few_episodes_cannot_meet_are_told(caplog):
    def check(episodes: int, **bounds) -> str:
        caplog.clear()
        changes = {"solved_below": {}, "num_episodes": episodes, "success": "survival"}
        SolvedCheck(failing_env(1), Still(), evaluation(**changes | bounds), 1)
        return caplog.text

    enough = episodes_to_show(BOUND)
    assert f"num_episodes >= {enough}" in check(enough - 1, solved_below={"failure_rate": BOUND})
    assert check(enough, solved_below={"failure_rate": BOUND}) == ""
    assert "success_rate" in check(4, solved_above={"success_rate": 0.9})
    assert check(4, solved_above={"mean_length": 1.0}) == ""
