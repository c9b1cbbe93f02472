"""Environments of the tasks that parts measure."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any, Literal

import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.tasks.registry import load_env_cfg

CARTPOLE = "Mjlab-Cartpole-Swingup"
GO1_FLAT = "Mjlab-Velocity-Flat-Unitree-Go1"
GO1_ROUGH = "Mjlab-Velocity-Rough-Unitree-Go1"
G1_FLAT = "Mjlab-Velocity-Flat-Unitree-G1"
G1_ROUGH = "Mjlab-Velocity-Rough-Unitree-G1"
LIFT_CUBE = "Mjlab-Lift-Cube-Yam"
LIFT_CUBE_RGB = "Mjlab-Lift-Cube-Yam-Rgb"
TRACKING = "Mjlab-Tracking-Flat-Unitree-G1"

_ACTION_SIZE = 0.3


def make_env(
    task: str,
    num_envs: int,
    device: str,
    engine: Literal["native", "warp"] = "warp",
    edit: Callable[[ManagerBasedRlEnvCfg], None] = lambda cfg: None,
) -> ManagerBasedRlEnv:
    """Return the task's environments, just reset, of seed 1, after an edit of their config."""
    cfg = load_env_cfg(task)
    cfg.scene.num_envs, cfg.sim.engine, cfg.seed = num_envs, engine, 1
    edit(cfg)
    env = ManagerBasedRlEnv(cfg, device=device)
    env.reset()
    return env


def random_actions(env: ManagerBasedRlEnv, generator: torch.Generator) -> torch.Tensor:
    """Return actions (N, A) on the host."""
    shape = (env.num_envs, env.action_manager.total_action_dim)
    return _ACTION_SIZE * torch.randn(shape, generator=generator)


def stepped_env(
    task: str, num_envs: int, device: str, steps: int
) -> tuple[ManagerBasedRlEnv, torch.Tensor]:
    """Return environments on Warp after `steps` steps, and the actions (N, A) of each."""
    env = make_env(task, num_envs, device)
    actions = random_actions(env, torch.Generator().manual_seed(0)).to(env.device)
    for _ in range(steps):
        env.step(actions)
    return env, actions


def close(env: Any) -> None:
    """Close environments and collect reference cycles."""
    env.close()
    gc.collect()
