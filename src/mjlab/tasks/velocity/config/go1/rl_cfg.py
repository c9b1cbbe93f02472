"""Learner configs of the velocity tasks of the Unitree Go1."""

from __future__ import annotations

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg, RslRlOnPolicyRunnerCfg
from mjlab.tasks.registry import Profile
from mjlab.tasks.velocity.rl.ppo import (
    cpu_with_gait,
    velocity_ppo_runner_cfg,
    with_blind_student,
)


def unitree_go1_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO config of all tasks."""
    return velocity_ppo_runner_cfg(experiment_name="go1_velocity", max_iterations=10_000)


# A trot: FR and RL, FL and RR. The trunk of a standing robot is 0.25 m above its feet.
cpu = cpu_with_gait(((0, 3), (1, 2)), minimum_height=0.17)
"""The `cpu` profile of all tasks: training stops once robots walk."""


def _ease_long(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlBaseRunnerCfg) -> None:
    """Ease as `cpu`; require fewer falls and smaller errors, judged by more episodes."""
    assert cpu.easing is not None
    cpu.easing(env_cfg, rl_cfg)
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 200
    evaluation.first_iteration, evaluation.min_interval = 700, 200
    evaluation.trigger_below = {"lin_vel_error": 0.21}
    evaluation.solved_below = {"lin_vel_error": 0.2, "ang_vel_error": 0.2, "failure_rate": 0.02}


cpu_long = Profile(cpu.policy, _ease_long)
"""The `cpu-long` profile of the flat tasks: `cpu`, until robots hardly fall."""

blind = with_blind_student(cpu)
"""The `blind` profile of the rough task: a student without height scan, of a teacher trained under `cpu`."""
