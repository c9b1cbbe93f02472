"""PPO settings, evaluation and `cpu` profile of the reach tasks.

A task is solved if 90 % of the goals are reached: within 5 cm and 0.35 rad at the end of the time for
the goal.
"""

from __future__ import annotations

from typing import Any

import torch

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import (
    EvaluationCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    gaussian_distribution,
)
from mjlab.tasks.cpu_profile import cpu_profile

_COMMAND = "hand_pose"


def reach_ppo_runner_cfg(experiment_name: str) -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of a reach task."""
    sizes = (256, 128, 64)
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=sizes, obs_normalization=True, distribution_cfg=gaussian_distribution()
        ),
        critic=RslRlModelCfg(hidden_dims=sizes, obs_normalization=True),
        experiment_name=experiment_name,
        save_interval=100,
        max_iterations=1_000,
        evaluation=EvaluationCfg(
            success=f"{__name__}:last_goal_reached",
            metrics=dict(GOAL_METRICS),
            units={"end_position_error": "m", "end_orientation_error": "rad"},
        ),
    )


def yam_reach_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of the YAM's task."""
    return reach_ppo_runner_cfg("yam_reach")


# Evaluation: goals at their ends.


def last_goal_reached(env: Any) -> torch.Tensor:
    """Return True if the frame is at its goal, (num_envs,) bool; read at the end of an episode."""
    return env.command_manager.get_term(_COMMAND).is_reached()


def goals_reached(env: Any) -> torch.Tensor:
    """Return the fraction of the episode's goals that were reached at their end; see `at_the_end`."""
    return at_the_end(env, "goals_reached")


def end_position_error(env: Any) -> torch.Tensor:
    """Return the mean position error at the end of the episode's goals (m); see `at_the_end`."""
    return at_the_end(env, "end_position_error")


def end_orientation_error(env: Any) -> torch.Tensor:
    """Return the mean orientation error at the end of the episode's goals (rad); see `at_the_end`."""
    return at_the_end(env, "end_orientation_error")


def at_the_end(env: Any, metric: str) -> torch.Tensor:
    """Return a metric of the command in the last step of an episode, times the number of steps, else 0.

    Evaluations average over the steps of an episode: the mean is the metric at the end. Episodes that
    end before their time limit have 0.
    """
    value = env.command_manager.get_term(_COMMAND).metrics[metric]
    is_last = env.episode_length_buf >= env.max_episode_length - 1
    return torch.where(is_last, value * env.max_episode_length, 0.0)


GOAL_METRICS = {
    "goals_reached": goals_reached,
    "end_position_error": end_position_error,
    "end_orientation_error": end_orientation_error,
}
"""Evaluation metrics by name."""


# Profiles.


def _evaluate(_env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    evaluation = rl_cfg.evaluation
    # 384 goals. An evaluation takes as long as nine iterations.
    evaluation.num_episodes = 128
    evaluation.first_iteration, evaluation.min_interval = 80, 40
    evaluation.solved_above = {"goals_reached": 0.9}


cpu = cpu_profile(
    _evaluate,
    simple_contacts=True,
    num_steps_per_env=16,
    hidden_dims=(256, 128),
    # The way to the goal is hardly longer than the horizon.
    gamma=0.9,
    max_iterations=1000,
)
"""Profile for a few CPU cores."""
