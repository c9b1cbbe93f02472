"""How the Unitree G1 learns the velocity tasks."""

from __future__ import annotations

from mjlab.rl.config import RslRlOnPolicyRunnerCfg
from mjlab.tasks.velocity.rl.ppo import velocity_ppo_runner_cfg


def unitree_g1_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of both tasks."""
    return velocity_ppo_runner_cfg(experiment_name="g1_velocity", max_iterations=30_000)
