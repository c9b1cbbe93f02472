"""Reach task: scores counted at the end of each goal."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.mdp import UniformPoseCommand, UniformPoseCommandCfg
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.rl.evaluation import EvaluationResult, evaluate_policy
from mjlab.tasks.reach.reach_env_cfg import make_reach_env_cfg
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

TASK = "Mjlab-Reach-Yam"
NUM_ENVS = 6
# Twenty steps of 0.02 s, whatever the rounding of timers.
GOAL_TIME = 0.39
MakeEnv = Callable[..., ManagerBasedRlEnv]


@pytest.fixture
def make_env() -> Iterator[MakeEnv]:
    envs: list[ManagerBasedRlEnv] = []

    def make(**tolerances: float) -> ManagerBasedRlEnv:
        cfg = load_env_cfg(TASK)
        cfg.scene.num_envs, cfg.seed, cfg.episode_length_s = NUM_ENVS, 1, 1.2
        command = cfg.commands["hand_pose"]
        command.resampling_time_range = (GOAL_TIME, GOAL_TIME)
        for name, value in tolerances.items():
            setattr(command, name, value)
        envs.append(ManagerBasedRlEnv(cfg, device="cpu"))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


def evaluate(env: ManagerBasedRlEnv, record: Callable[[], None] = lambda: None) -> EvaluationResult:
    """Evaluate an arm that holds its default pose; `record` is called before each step."""

    def policy(observations: object) -> torch.Tensor:
        record()
        return torch.zeros(NUM_ENVS, 6)

    evaluation = load_rl_cfg(TASK).evaluation
    return evaluate_policy(
        RslRlVecEnvWrapper(env),
        policy,
        success=evaluation.success,
        metrics=evaluation.metrics,
        seed=3,
    )


def test_scores_are_means_over_the_ends_of_goals(make_env: MakeEnv) -> None:
    env = make_env()
    command = env.command_manager.get_term("hand_pose")
    assert isinstance(command, UniformPoseCommand)
    errors: list[torch.Tensor] = []
    result = evaluate(env, lambda: errors.append(torch.stack(command.errors())))
    assert len(errors) == 60
    # One step before the end of each goal: the arm moves slowly.
    distance, angle = torch.stack(errors[19::20]).mean(dim=(0, 2)).tolist()
    assert result.value("end_position_error") == pytest.approx(distance, rel=0.05)
    assert result.value("end_orientation_error") == pytest.approx(angle, rel=0.05)
    assert result.value("goals_reached") == result.success_rate == 0.0


def test_a_goal_is_reached_within_both_tolerances(make_env: MakeEnv) -> None:
    anywhere = make_env(position_tolerance=10.0, orientation_tolerance=4.0)
    assert evaluate(anywhere).value("goals_reached") == pytest.approx(1.0)
    assert evaluate(anywhere).success_rate == 1.0
    turned = make_env(position_tolerance=10.0)
    assert evaluate(turned).value("goals_reached") < 0.5


def test_the_base_config_is_new_each_time() -> None:
    one, other = make_reach_env_cfg(), make_reach_env_cfg()
    assert one == other
    command = one.commands["hand_pose"]
    assert isinstance(command, UniformPoseCommandCfg)
    command.position_tolerance = 1.0
    one.rewards["position"].weight = 2.0
    assert other == make_reach_env_cfg()
    assert load_env_cfg(TASK, play=True).episode_length_s > 1e8
