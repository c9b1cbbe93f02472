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
    Undo,
    coarsen_physics,
    ease_pushes,
    ease_weight,
    part_of,
    undo_all,
)
from mjlab.tasks.tracking.evaluation import play_motions_once
from mjlab.tasks.tracking.mdp import MotionCommandCfg
from mjlab.tasks.tracking.mdp._shared import motion_command

_COMMAND, _EASED_STARTS = "motion", "eased_starts"
_ACTION_RATE = "action_rate_l2"
_NUM_ENVS = 512
_ACTION_RATE_AT_FIRST = 0.05
_ACTION_RATE_SAMPLES = 6_000_000
_CALM_SAMPLES = 4_000_000
_UNPUSHED_SAMPLES = 12_000_000


def cpu(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of a tracking task in place."""
    env_cfg.scene.num_envs = _NUM_ENVS
    weight = env_cfg.rewards[_ACTION_RATE]
    first = 0.0 if weight is None else _ACTION_RATE_AT_FIRST * weight.weight
    undos = [
        coarsen_physics(env_cfg),
        ease_weight(env_cfg, _ACTION_RATE, first, _ACTION_RATE_SAMPLES // _NUM_ENVS),
        ease_pushes(env_cfg, _UNPUSHED_SAMPLES // _NUM_ENVS),
        _ease_starts(env_cfg, _CALM_SAMPLES // _NUM_ENVS),
    ]
    rl_cfg.evaluation.prepare_env = undo_all([*undos, play_motions_once])
    _learn_from_few_samples(rl_cfg)
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 200
    evaluation.min_interval = 150
    evaluation.solved_below = {"r_mpkpe": 0.05}
    evaluation.solved_above = {"success_rate": 0.9}


def _ease_starts(env_cfg: ManagerBasedRlEnvCfg, steps: int) -> Undo:
    motion = env_cfg.commands[_COMMAND]
    assert isinstance(motion, MotionCommandCfg)
    full = {
        "pose_range": motion.pose_range,
        "velocity_range": motion.velocity_range,
        "joint_position_range": motion.joint_position_range,
    }
    env_cfg.curriculum[_EASED_STARTS] = CurriculumTermCfg(
        func=growing_starts, params={"command_name": _COMMAND, "steps": steps, **full}
    )

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        command = eased.commands.get(_COMMAND)
        growing = eased.curriculum.pop(_EASED_STARTS, None)
        if command is not None and growing is not None:
            # Those of a training under way are as large as they have grown by then.
            for name in full:
                setattr(command, name, growing.params[name])

    return undo


def growing_starts(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | slice,
    command_name: str,
    pose_range: dict[str, tuple[float, float]],
    velocity_range: dict[str, tuple[float, float]],
    joint_position_range: tuple[float, float],
    steps: int,
) -> float:
    """Let perturbations of starts grow from nothing to these ranges over `steps` environment steps.

    Returns the fraction that they have reached, for logging.
    """
    fraction = min(env.common_step_counter / steps, 1.0)
    motion = motion_command(env, command_name).cfg
    motion.pose_range = part_of(pose_range, fraction)
    motion.velocity_range = part_of(velocity_range, fraction)
    low, high = joint_position_range
    motion.joint_position_range = (fraction * low, fraction * high)
    return fraction


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
