"""The `cpu` profile: settings of the manipulation tasks for a few cores.

A few cores step some ten thousand environments a second, a hundredth of a GPU. So a batch is small,
and the networks are small enough for their update not to take longer than the physics. The
numbers are a start; how fast they learn has not been measured yet.
"""

from __future__ import annotations

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlOnPolicyRunnerCfg


def cpu(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of the task from the state in place."""
    env_cfg.scene.num_envs = 512
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (128, 64)
    _learn_from_small_batches(rl_cfg)


def cpu_vision(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of a task from images in place."""
    # Encoders take most of the time, of the update above all.
    env_cfg.scene.num_envs = 256
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (128, 64)
    _learn_from_small_batches(rl_cfg)


def _learn_from_small_batches(rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    rl_cfg.algorithm.entropy_coef = 0.01
    rl_cfg.algorithm.desired_kl = 0.03
    rl_cfg.algorithm.gamma = 0.97
    rl_cfg.num_steps_per_env = 12
    rl_cfg.max_iterations = 6000
    rl_cfg.save_interval = 200
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 256
    evaluation.trigger_return = 2000.0
    evaluation.min_interval = 150
    evaluation.solved_above = {"success_rate": 0.9}
