"""The `cpu` profile: settings of the manipulation tasks for a few cores.

A few cores step some ten thousand environments a second, a hundredth of a GPU. So a batch is small,
and the networks are small enough for their update not to take longer than the physics.

That is all that the tasks from images get; how fast these learn has not been measured. From the state,
the task's own reward for reaching is so wide (0.2 m) that closed fingers on top of the cube get 98 %
of it, and a gripper takes half a second to open or to close. So training has a narrow one beside it,
which only open fingers around the cube can get, and contacts without rolling and torsional friction.
Evaluations, `evaluate` and `play` have neither.
"""

from __future__ import annotations

from typing import Any

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import RewardTermCfg
from mjlab.rl.config import RslRlOnPolicyRunnerCfg
from mjlab.tasks.simple_contacts import simplify_contacts

_REACH, _NARROW_REACH = "lift", "lift_narrow"
_NARROW_STD = 0.04


def cpu(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of the task from the state in place."""
    env_cfg.scene.num_envs = 512
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (128, 64)
    _reward_narrow_reach(env_cfg)
    undo_contacts = simplify_contacts(env_cfg)

    def undo(cfg: ManagerBasedRlEnvCfg) -> None:
        undo_contacts(cfg)
        cfg.rewards.pop(_NARROW_REACH, None)

    rl_cfg.evaluation.prepare_env = undo
    _learn_from_small_batches(rl_cfg)


def _reward_narrow_reach(env_cfg: ManagerBasedRlEnvCfg) -> None:
    wide = env_cfg.rewards[_REACH]
    if wide is not None:
        params: dict[str, Any] = {**wide.params, "reaching_std": _NARROW_STD}
        env_cfg.rewards[_NARROW_REACH] = RewardTermCfg(
            func=wide.func, weight=wide.weight, params=params
        )


def cpu_vision(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of a task from images in place."""
    # Encoders take most of the time, of the update above all.
    env_cfg.scene.num_envs = 256
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (128, 64)
    _learn_from_small_batches(rl_cfg)
    # Of at most 3000.
    rl_cfg.evaluation.trigger_return = 1800.0


def _learn_from_small_batches(rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    rl_cfg.algorithm.entropy_coef = 0.01
    rl_cfg.algorithm.desired_kl = 0.03
    rl_cfg.algorithm.gamma = 0.98
    rl_cfg.num_steps_per_env = 16
    rl_cfg.max_iterations = 6000
    rl_cfg.save_interval = 200
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 256
    evaluation.min_interval = 150
    evaluation.solved_above = {"success_rate": 0.9}
