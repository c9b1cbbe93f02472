"""Cartpole tasks: swing-up and balance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.tasks.registry import register_mjlab_task
from mjlab.utils.lazy import lazy_names

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

# Functions are registered by name: listing tasks must import neither torch nor MuJoCo.
register_mjlab_task(
    task_id="Mjlab-Cartpole-Balance",
    env_cfg=f"{_CFG}:cartpole_balance_env_cfg",
    rl_cfg=f"{_CFG}:cartpole_ppo_runner_cfg",
    profiles={"cpu": f"{_CFG}:cpu"},
)
register_mjlab_task(
    task_id="Mjlab-Cartpole-Swingup",
    env_cfg=f"{_CFG}:cartpole_swingup_env_cfg",
    rl_cfg=f"{_CFG}:cartpole_ppo_runner_cfg",
    profiles={"cpu": f"{_CFG}:cpu"},
)


__getattr__ = lazy_names(
    __name__,
    dict.fromkeys(
        ("cartpole_balance_env_cfg", "cartpole_ppo_runner_cfg", "cartpole_swingup_env_cfg"), _CFG
    ),
)
