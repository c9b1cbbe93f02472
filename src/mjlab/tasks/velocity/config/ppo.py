"""What all robots share of how they learn the velocity task."""

from __future__ import annotations

from mjlab.rl.config import (
    EvaluationCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    RslRlPpoAlgorithmCfg,
    gaussian_distribution,
)
from mjlab.tasks.velocity.tracking_errors import TRACKING_ERRORS


def velocity_ppo_runner_cfg(experiment_name: str, max_iterations: int) -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of a robot."""
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(512, 256, 128),
            obs_normalization=True,
            distribution_cfg=gaussian_distribution(),
        ),
        critic=RslRlModelCfg(hidden_dims=(512, 256, 128), obs_normalization=True),
        algorithm=RslRlPpoAlgorithmCfg(entropy_coef=0.01),
        experiment_name=experiment_name,
        max_iterations=max_iterations,
        evaluation=EvaluationCfg(metrics=dict(TRACKING_ERRORS)),
    )
