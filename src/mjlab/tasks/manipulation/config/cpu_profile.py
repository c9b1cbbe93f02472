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
from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.tasks.easing import Undo

_REACH, _NARROW_REACH = "lift", "lift_narrow"
_NARROW_STD = 0.04


def _reward_narrow_reach(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> Undo:
    wide = env_cfg.rewards[_REACH]
    if wide is not None:
        params: dict[str, Any] = {**wide.params, "reaching_std": _NARROW_STD}
        env_cfg.rewards[_NARROW_REACH] = RewardTermCfg(
            func=wide.func, weight=wide.weight, params=params
        )
    _evaluate(env_cfg, rl_cfg)

    def undo(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.rewards.pop(_NARROW_REACH, None)

    return undo


def _evaluate_from_images(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    _evaluate(env_cfg, rl_cfg)
    # Of at most 3000.
    rl_cfg.evaluation.trigger_return = 1800.0


def _evaluate(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 256
    evaluation.min_interval = 150
    evaluation.solved_above = {"success_rate": 0.9}


_SHARED: dict[str, Any] = {
    "num_steps_per_env": 16,
    "gamma": 0.98,
    "max_iterations": 6000,
    "save_interval": 200,
}

cpu = cpu_profile(_reward_narrow_reach, simple_contacts=True, **_SHARED)
"""Profile of the task from the state."""

# Encoders take most of the time, of the update above all.
cpu_vision = cpu_profile(_evaluate_from_images, num_envs=256, **_SHARED)
"""Profile of the tasks from images."""
