"""The `cpu` profile: settings of motion tracking for a few cores.

A few cores step some thousands of environments a second, a hundredth of a GPU. A humanoid with soft
drives falls within a second unless it balances, and that is what takes most of the learning. So the
profile makes the task easier to learn, not easier to pass:

- Starts are perturbed, and robots pushed, by nothing at first and by as much as in the task later; the
  penalty for quick actions grows likewise.
- The physics takes two steps of 10 ms for a step of the environment, instead of four of 5 ms.
- The policy starts out as a position controller on the reference (`ReferenceActor`).
- Batches and networks are small, a policy may change more in an iteration, and rewards far away count
  less.

Evaluations, `play` and `evaluate` undo the first two: what they show is the task as it is.
"""

from __future__ import annotations

import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.rl.config import RslRlOnPolicyRunnerCfg, gaussian_distribution
from mjlab.tasks.easing import (
    Easing,
    coarsen_physics,
    drop_easing,
    ease_pushes,
    ease_weight,
    undo_all,
)
from mjlab.tasks.tracking.evaluation import play_motions_once
from mjlab.tasks.tracking.mdp._shared import motion_command

_COMMAND = "motion"
_ACTION_RATE = "action_rate_l2"
# By which samples become the steps that curricula count; more environments are eased for as many steps.
_NUM_ENVS = 512
_ACTION_RATE_AT_FIRST = 0.05
_ACTION_RATE_SAMPLES = 6_000_000
_CALM_SAMPLES = 4_000_000
_UNPUSHED_SAMPLES = 12_000_000


def cpu(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of a tracking task in place."""
    env_cfg.scene.num_envs = _NUM_ENVS
    undos = [drop_easing, coarsen_physics(env_cfg, num_steps=2), play_motions_once]
    rl_cfg.evaluation.prepare_env = undo_all(undos)
    penalty = env_cfg.rewards[_ACTION_RATE]
    if penalty is not None:
        first = _ACTION_RATE_AT_FIRST * penalty.weight
        ease_weight(env_cfg, _ACTION_RATE, first, _ACTION_RATE_SAMPLES // _NUM_ENVS)
    ease_pushes(env_cfg, _UNPUSHED_SAMPLES // _NUM_ENVS)
    params = {"command_name": _COMMAND, "steps": _CALM_SAMPLES // _NUM_ENVS}
    env_cfg.curriculum["eased_starts"] = CurriculumTermCfg(func=GrowingStarts, params=params)
    _learn_from_few_samples(rl_cfg)
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 200
    evaluation.min_interval = 150
    evaluation.solved_below = {"r_mpkpe": 0.05}
    evaluation.solved_above = {"success_rate": 0.9}


class GrowingStarts(Easing):
    """Lets the perturbation of starts grow from nothing to what the command's config says.

    Returns the fraction that it has reached.
    """

    def __call__(
        self, env: ManagerBasedRlEnv, env_ids: torch.Tensor | slice, command_name: str, steps: int
    ) -> float:
        command = motion_command(env, command_name)
        command.start_perturbation = self.fraction(steps)
        return command.start_perturbation


def _learn_from_few_samples(rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (256, 128)
    rl_cfg.actor.class_name = "mjlab.tasks.tracking.rl.reference_actor:ReferenceActor"
    rl_cfg.actor.distribution_cfg = gaussian_distribution(0.8)
    rl_cfg.algorithm.entropy_coef = 0.005
    rl_cfg.algorithm.desired_kl = 0.05
    rl_cfg.algorithm.gamma = 0.98
    rl_cfg.num_steps_per_env = 12
    rl_cfg.max_iterations = 6000
    rl_cfg.save_interval = 200
