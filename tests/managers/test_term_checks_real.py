"""Complex tensors and tensors without data raise errors that name the term."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers import (
    MetricsTermCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
)
from mjlab.tasks.registry import load_env_cfg

KINDS = {
    "complex64": lambda *size: torch.ones(*size, dtype=torch.complex64),
    "meta": lambda *size: torch.ones(*size, device="meta"),
}


def add_term(cfg: ManagerBasedRlEnvCfg, manager: str, func: Any) -> None:
    if manager == "RewardManager":
        cfg.rewards["mine"] = RewardTermCfg(func=func, weight=1.0)
    elif manager == "TerminationManager":
        cfg.terminations["mine"] = TerminationTermCfg(func=func)
    elif manager == "MetricsManager":
        cfg.metrics["mine"] = MetricsTermCfg(func=func)
    else:
        term = ObservationTermCfg(func=lambda env: func(env)[:, None])
        cfg.observations["actor"].terms["mine"] = term


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "manager", ["RewardManager", "TerminationManager", "MetricsManager", "Observation"]
)
def test_a_term_without_real_numbers_is_named(manager: str, kind: str, late: bool):
    def func(env: Any) -> torch.Tensor:
        sound = late and getattr(env, "common_step_counter", 0) < 2
        return torch.zeros(env.num_envs) if sound else KINDS[kind](env.num_envs)

    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs = 2
    add_term(cfg, manager, func)
    with pytest.raises(TypeError, match=f"{manager} term '.*mine'.*{kind}"):
        env = ManagerBasedRlEnv(cfg, device="cpu")
        env.reset()
        for _ in range(3):
            env.step(torch.zeros(2, 1))
