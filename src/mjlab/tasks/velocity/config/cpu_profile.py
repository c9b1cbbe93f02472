"""The `cpu` profile: settings of the velocity tasks for a few cores.

A few cores step some ten thousand environments a second, a hundredth of a GPU. So a batch is small,
and the networks are small enough for their update not to take longer than the physics. The
numbers are a start; how fast they learn has not been measured yet.
"""

from __future__ import annotations

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlOnPolicyRunnerCfg


def cpu(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    """Edit the configs of a velocity task in place."""
    env_cfg.scene.num_envs = 512
    rl_cfg.actor.hidden_dims = rl_cfg.critic.hidden_dims = (128, 64)
    rl_cfg.actor.distribution_cfg = {
        "class_name": "GaussianDistribution",
        "init_std": 1.0,
        "std_type": "scalar",
    }
    rl_cfg.algorithm.entropy_coef = 0.01
    rl_cfg.algorithm.desired_kl = 0.02
    rl_cfg.algorithm.num_learning_epochs = 4
    rl_cfg.num_steps_per_env = 12
    rl_cfg.max_iterations = 2000
    rl_cfg.save_interval = 100
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 200
    evaluation.min_interval = 100
    evaluation.solved_below = {"lin_vel_error": 0.25, "ang_vel_error": 0.35, "failure_rate": 0.05}
