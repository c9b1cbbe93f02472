"""Cartpole: a pole on a cart, to be swung up, or only to be kept upright."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.tasks.registry import register_mjlab_task

if TYPE_CHECKING:
    from mjlab.tasks.cartpole.cartpole_env_cfg import (
        cartpole_balance_env_cfg as cartpole_balance_env_cfg,
    )
    from mjlab.tasks.cartpole.cartpole_env_cfg import (
        cartpole_ppo_runner_cfg as cartpole_ppo_runner_cfg,
    )
    from mjlab.tasks.cartpole.cartpole_env_cfg import (
        cartpole_swingup_env_cfg as cartpole_swingup_env_cfg,
    )

_CFG = "mjlab.tasks.cartpole.cartpole_env_cfg"

# Functions are given by name, so that listing the tasks imports neither torch nor MuJoCo.
register_mjlab_task(
    task_id="Mjlab-Cartpole-Balance",
    env_cfg=f"{_CFG}:cartpole_balance_env_cfg",
    rl_cfg=f"{_CFG}:cartpole_ppo_runner_cfg",
)
register_mjlab_task(
    task_id="Mjlab-Cartpole-Swingup",
    env_cfg=f"{_CFG}:cartpole_swingup_env_cfg",
    rl_cfg=f"{_CFG}:cartpole_ppo_runner_cfg",
    profiles={"cpu": "mjlab.tasks.cartpole.cpu_profile:cpu"},
)


def __getattr__(name: str) -> Any:
    if name.startswith("cartpole_"):
        import importlib

        return getattr(importlib.import_module(_CFG), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
