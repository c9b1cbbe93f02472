"""Metric terms, (N,). Logged, not rewarded."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnv


__all__ = [
    "mean_action_acc",
]


def mean_action_acc(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Mean absolute second difference of the raw action over its components."""
    actions = env.action_manager
    second = actions.action - 2.0 * actions.prev_action + actions.prev_prev_action
    return second.abs().mean(dim=1)
