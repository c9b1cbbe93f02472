"""PPO settings, evaluation and `cpu` profile, with SAC, of the reach tasks.

A task is solved if 91 % of the goals are reached: within 5 cm and 0.35 rad at the end of the time for
the goal.
"""

from __future__ import annotations

from typing import Any

import torch

from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg
from mjlab.rl.config import (
    EvaluationCfg,
    RslRlModelCfg,
    RslRlOffPolicyRunnerCfg,
    RslRlOnPolicyRunnerCfg,
    gaussian_distribution,
    squashed_gaussian,
)
from mjlab.rl.learners import with_learner
from mjlab.tasks.easing import simplify_contacts
from mjlab.tasks.reach.teacher import goal_hand_motion, goal_joint_action
from mjlab.tasks.registry import Profile

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


# Profile for a few CPU cores.

_TEACHER = "teacher"
# Largest distance of a joint's target from its measured position (rad). With absolute targets, a network also
# has to learn where the joints are: 81 instead of 90 % of a Panda's goals, without physics.
_STEP = 0.5
# Motion of the hand that counts as much as a unit action in imitation (m, rad).
_LENGTHS = (0.16, 0.7)
# Time of a goal in training (s). With the teacher's actions, a Panda is at 94 % of its goals by then.
_TRAINING_TIME = 1.0
# Of the YAM: 90 % of the goals by then, 93 % after 55.
_FIRST_EVALUATION = 40


def _set_policy(
    env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg
) -> RslRlOffPolicyRunnerCfg:
    """Set relative targets, and let SAC imitate those at the goals, which the policy does not observe."""
    action = env_cfg.actions["joint_pos"]
    assert isinstance(action, mdp.JointPositionActionCfg)
    env_cfg.actions["joint_pos"] = mdp.RelativeJointPositionActionCfg(
        entity_name=action.entity_name,
        actuator_names=action.actuator_names,
        preserve_order=action.preserve_order,
        scale=_STEP,
        read_every_substep=False,
    )
    terms = {
        "joints": ObservationTermCfg(func=goal_joint_action, params={"command_name": _COMMAND}),
        "hand": ObservationTermCfg(
            func=goal_hand_motion, params={"command_name": _COMMAND, "lengths": _LENGTHS}
        ),
    }
    env_cfg.observations[_TEACHER] = ObservationGroupCfg(terms=terms)
    cfg = with_learner(rl_cfg, "sac")
    assert isinstance(cfg, RslRlOffPolicyRunnerCfg)
    cfg.num_steps_per_env, cfg.max_iterations = 25, 400
    cfg.actor.hidden_dims, cfg.critic.hidden_dims = (512, 256), (128, 64)
    cfg.actor.distribution_cfg = squashed_gaussian(0.05, log_std_max=-2.0)
    algorithm = cfg.algorithm
    algorithm.num_updates, algorithm.batch_size, algorithm.policy_delay = 4, 1024, 1
    algorithm.learning_starts = 4
    # The way to the goal is hardly longer than the horizon.
    algorithm.gamma = 0.9
    algorithm.actor_learning_rate, algorithm.critic_learning_rate = 3e-3, 1e-3
    algorithm.target_std = 0.05
    algorithm.policy_average = 0.05
    algorithm.use_mixed_precision = True
    algorithm.teacher, algorithm.imitation = _TEACHER, ((0, 20.0),)
    return cfg


def _ease(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOffPolicyRunnerCfg) -> None:
    env_cfg.scene.num_envs = 512
    simplify_contacts(env_cfg)
    command = env_cfg.commands[_COMMAND]
    assert isinstance(command, mdp.UniformPoseCommandCfg)
    command.resampling_time_range = (_TRAINING_TIME, _TRAINING_TIME)
    command.num_goals = 8192
    # 384 goals. An evaluation takes as long as five iterations.
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 128
    evaluation.first_iteration, evaluation.min_interval = _FIRST_EVALUATION, 15
    # Of new goals a little less is reached: a UR5e that stopped at 90.6 % reached 88.8 % (87.0 to 90.7).
    evaluation.solved_above = {"goals_reached": 0.91}


cpu = Profile(_set_policy, _ease)
"""Profile for a few CPU cores."""
