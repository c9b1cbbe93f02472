"""How the Unitree G1 learns to imitate."""

from __future__ import annotations

from mjlab.rl.config import (
    EvaluationCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    gaussian_distribution,
)
from mjlab.tasks.tracking.evaluation import TRACKING_ERRORS, play_motions_once


def unitree_g1_tracking_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of both tasks."""
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(512, 256, 128),
            obs_normalization=True,
            distribution_cfg=gaussian_distribution(),
        ),
        critic=RslRlModelCfg(hidden_dims=(512, 256, 128), obs_normalization=True),
        experiment_name="g1_tracking",
        save_interval=500,
        max_iterations=30_000,
        evaluation=EvaluationCfg(
            metrics=dict(TRACKING_ERRORS),
            prepare_env=play_motions_once,
            success_is_survival=True,
        ),
    )
