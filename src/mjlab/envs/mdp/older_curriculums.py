"""Curriculum terms as releases 1.1 and 1.2 spelled them; reached through `mjlab.compat` only."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

import torch

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


class RewardWeightStage(TypedDict):
    """A reward weight, and the number of environment steps after which it holds."""

    step: int
    weight: float


def reward_weight(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor,
    reward_name: str,
    weight_stages: list[RewardWeightStage],
) -> torch.Tensor:
    """Set a reward's weight to that of the last stage whose step has been passed, and return it.

    Unlike `reward_curriculum`, a stage starts one step after its `step`.
    """
    cfg = env.reward_manager.get_term_cfg(reward_name)
    for stage in weight_stages:
        if env.common_step_counter > stage["step"]:
            cfg.weight = stage["weight"]
    return torch.tensor([cfg.weight])
