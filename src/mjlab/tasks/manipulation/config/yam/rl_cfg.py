"""How the YAM arm learns the manipulation tasks."""

from __future__ import annotations

from typing import Any

from mjlab.rl.config import (
    EvaluationCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    gaussian_distribution,
)
from mjlab.tasks.manipulation.success import PLACEMENT, placed_at_goal

_CNN: dict[str, Any] = {
    "output_channels": [16, 32],
    "kernel_size": [5, 3],
    "stride": [2, 2],
    "padding": "zeros",
    "activation": "elu",
    "max_pool": False,
    "global_pool": "none",
    "spatial_softmax": True,
    "spatial_softmax_temperature": 1.0,
}


def yam_lift_cube_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of the task from the state."""
    sizes = (512, 256, 128)
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=sizes, obs_normalization=True, distribution_cfg=gaussian_distribution()
        ),
        critic=RslRlModelCfg(hidden_dims=sizes, obs_normalization=True),
        experiment_name="yam_lift_cube",
        save_interval=100,
        max_iterations=5_000,
        evaluation=_evaluation(),
    )


def yam_lift_cube_vision_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of the tasks from images of one cube."""
    return _vision("yam_lift_cube_vision")


def yam_multi_cube_seg_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of the task from images of several cubes."""
    return _vision("yam_multi_cube_seg")


def _vision(experiment_name: str) -> RslRlOnPolicyRunnerCfg:
    """Return settings with an encoder of images in front of each network."""

    def model(distribution_cfg: dict[str, Any] | None) -> RslRlModelCfg:
        return RslRlModelCfg(
            hidden_dims=(256, 256, 128),
            obs_normalization=True,
            cnn_cfg=dict(_CNN),
            distribution_cfg=distribution_cfg,
            class_name="mjlab.rl.spatial_softmax:SpatialSoftmaxCNNModel",
        )

    return RslRlOnPolicyRunnerCfg(
        actor=model(gaussian_distribution()),
        critic=model(None),
        obs_groups={"actor": ("actor", "camera"), "critic": ("critic", "camera")},
        experiment_name=experiment_name,
        save_interval=100,
        max_iterations=3_000,
        evaluation=_evaluation(),
    )


def _evaluation() -> EvaluationCfg:
    return EvaluationCfg(success_func=placed_at_goal, metrics=dict(PLACEMENT))
