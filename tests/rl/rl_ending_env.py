"""Cartpoles whose episodes end when a test wants them to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import TerminationTermCfg
from mjlab.tasks.registry import load_env_cfg

TASK = "Mjlab-Cartpole-Swingup"


def due(steps: Sequence[int]) -> Callable[[Any], torch.Tensor]:
    """Return a termination of environment i when its episode has `steps[i]` steps."""
    return lambda env: env.episode_length_buf >= torch.tensor(steps)


def ends(cfg: Any, failed: Sequence[int], time_out: Sequence[int]) -> None:
    """Let environment i of `cfg` fail after `failed[i]` steps, and run out of time after `time_out[i]`."""
    cfg.episode_length_s = 100.0
    cfg.terminations = {
        "failed": TerminationTermCfg(func=due(failed)),
        "time_out": TerminationTermCfg(func=due(time_out), time_out=True),
    }


def ending_env(
    failed: Sequence[int], time_out: Sequence[int], auto_reset: bool = True
) -> ManagerBasedRlEnv:
    """Return an environment with the episode ends of `ends`."""
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = len(failed), 5, "native"
    cfg.auto_reset = auto_reset
    ends(cfg, failed, time_out)
    return ManagerBasedRlEnv(cfg, device="cpu")
