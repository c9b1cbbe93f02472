"""The `cpu` profile: settings of motion tracking for a few cores.

A few cores step some thousands of environments a second, a hundredth of a GPU. So a batch is small,
and the networks are small enough for their update not to take longer than the physics.
"""

from __future__ import annotations

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlOnPolicyRunnerCfg, gaussian_distribution


def cpu(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of a tracking task in place."""
    env_cfg.scene.num_envs = 512
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (256, 128)
    rl_cfg.actor.distribution_cfg = gaussian_distribution(0.5)
    rl_cfg.algorithm.entropy_coef = 0.005
    rl_cfg.algorithm.desired_kl = 0.03
    rl_cfg.algorithm.gamma = 0.97
    rl_cfg.num_steps_per_env = 12
    rl_cfg.max_iterations = 6000
    rl_cfg.save_interval = 200
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 200
    evaluation.min_interval = 300
    evaluation.solved_below = {"r_mpkpe": 0.05}
    evaluation.solved_above = {"success_rate": 0.9}
