"""PPO settings and `cpu` profile of Unitree G1 motion tracking.

A few CPU cores simulate some thousands of environment steps per second, a hundredth of a GPU. A
humanoid with soft position actuators falls within a second unless it balances, and learning to
balance takes most of the training. The profile makes the task easier to learn, not easier to pass:

- Start perturbations, pushes and the action rate penalty start small and grow to the task's values.
- The physics takes two steps of 10 ms per environment step instead of four of 5 ms.
- The policy is initialized as a position controller on the reference (`ReferenceActor`).
- Batches and networks are smaller, the desired KL divergence is larger, and the discount factor is
  smaller.

Evaluations, `play` and `evaluate` run the original task, without the first two.
"""

from __future__ import annotations

import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.rl.config import (
    EvaluationCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    gaussian_distribution,
)
from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.tasks.easing import Easing, ease_weight
from mjlab.tasks.tracking.mdp.commands import motion_command
from mjlab.tasks.tracking.mdp.metrics import TRACKING_ERRORS, UNITS

_COMMAND = "motion"
_ACTION_RATE = "action_rate_l2"
_NUM_ENVS = 512
_ACTION_RATE_AT_FIRST = 0.05
_ACTION_RATE_SAMPLES = 6_000_000
_CALM_SAMPLES = 4_000_000


def unitree_g1_tracking_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of both tasks."""
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(512, 256, 128),
            obs_normalization=True,
            distribution_cfg=gaussian_distribution(),
        ),
        critic=RslRlModelCfg(hidden_dims=(512, 256, 128), obs_normalization=True),
        experiment_name="g1_tracking",
        save_interval=500,
        max_iterations=30_000,
        evaluation=EvaluationCfg(
            metrics=dict(TRACKING_ERRORS),
            units=dict(UNITS),
            success="survival",
        ),
    )


# `cpu` profile.


def _ease(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    if (penalty := env_cfg.rewards[_ACTION_RATE]) is not None:
        first = _ACTION_RATE_AT_FIRST * penalty.weight
        ease_weight(env_cfg, _ACTION_RATE, first, _ACTION_RATE_SAMPLES // _NUM_ENVS)
    params = {"command_name": _COMMAND, "steps": _CALM_SAMPLES // _NUM_ENVS}
    env_cfg.curriculum["eased_starts"] = CurriculumTermCfg(func=GrowingStarts, params=params)
    rl_cfg.actor.class_name = "mjlab.tasks.tracking.rl.reference_actor:ReferenceActor"
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 200
    # Squat and wave, seed 1: 14, 54, 80 and 93 % after 150, 300, 450 and 600 iterations.
    evaluation.first_iteration = 450
    evaluation.min_interval = 75
    evaluation.solved_below = {"r_mpkpe": 0.05}
    evaluation.solved_above = {"success_rate": 0.9}


class GrowingStarts(Easing):
    """Curriculum that scales start perturbations from zero to the command's configured ranges.

    Returns the current scale, from 0 to 1.
    """

    def __call__(
        self, env: ManagerBasedRlEnv, env_ids: torch.Tensor | slice, command_name: str, steps: int
    ) -> float:
        command = motion_command(env, command_name)
        command.start_perturbation = self.fraction(steps)
        return command.start_perturbation


cpu = cpu_profile(
    _ease,
    num_envs=_NUM_ENVS,
    hidden_dims=(256, 128),
    init_std=0.8,
    entropy_coef=0.005,
    gamma=0.98,
    max_iterations=6000,
    save_interval=200,
    physics_steps=2,
    unpushed_samples=12_000_000,
)
"""`cpu` profile of the tracking tasks."""
