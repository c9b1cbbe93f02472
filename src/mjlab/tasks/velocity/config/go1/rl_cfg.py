"""Learner configs of the velocity tasks of the Unitree Go1."""

from __future__ import annotations

from mjlab.rl.config import RslRlOnPolicyRunnerCfg
from mjlab.tasks.velocity.rl.ppo import (
    cpu_with_gait,
    evaluate_long,
    velocity_ppo_runner_cfg,
)


def unitree_go1_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO config of all tasks."""
    return velocity_ppo_runner_cfg(experiment_name="go1_velocity", max_iterations=10_000)


# A trot: FR and RL, FL and RR.
_TROT = ((0, 3), (1, 2))
# The trunk of a standing robot is 0.25 m above its feet.
_MINIMUM_HEIGHT = 0.17
cpu = cpu_with_gait(_TROT, minimum_height=_MINIMUM_HEIGHT)
"""The `cpu` profile of all tasks: training stops once robots walk."""
cpu_long = cpu_with_gait(_TROT, minimum_height=_MINIMUM_HEIGHT, evaluate=evaluate_long)
"""The `cpu-long` profile of the flat tasks: `cpu`, until robots hardly fall."""
