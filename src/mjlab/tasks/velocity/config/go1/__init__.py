"""Velocity tasks of the Unitree Go1. Names are imported on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.tasks.registry import register_mjlab_task as register_mjlab_task
from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.tasks.velocity.config.go1.env_cfgs import (
        unitree_go1_flat_env_cfg as unitree_go1_flat_env_cfg,
    )
    from mjlab.tasks.velocity.config.go1.env_cfgs import (
        unitree_go1_flat_no_state_estimation_env_cfg as unitree_go1_flat_no_state_estimation_env_cfg,
    )
    from mjlab.tasks.velocity.config.go1.env_cfgs import (
        unitree_go1_rough_env_cfg as unitree_go1_rough_env_cfg,
    )
    from mjlab.tasks.velocity.config.go1.env_cfgs import (
        unitree_go1_rough_no_state_estimation_env_cfg as unitree_go1_rough_no_state_estimation_env_cfg,
    )
    from mjlab.tasks.velocity.config.go1.rl_cfg import (
        unitree_go1_ppo_runner_cfg as unitree_go1_ppo_runner_cfg,
    )
    from mjlab.tasks.velocity.rl import VelocityOnPolicyRunner as VelocityOnPolicyRunner

_ENV_CFGS = "mjlab.tasks.velocity.config.go1.env_cfgs"
_RL_CFG = "mjlab.tasks.velocity.config.go1.rl_cfg"
_RUNNER = "mjlab.tasks.velocity.rl"

for _terrain in ("Flat", "Rough"):
    for _suffix in ("", "-No-State-Estimation"):
        _profiles = {"cpu": f"{_RL_CFG}:cpu"}
        if _terrain == "Flat":
            _profiles["cpu-long"] = f"{_RL_CFG}:cpu_long"
        elif not _suffix:
            _profiles["blind"] = f"{_RL_CFG}:blind"
        _env_cfg = f"unitree_go1_{_terrain}{_suffix}_env_cfg".lower().replace("-", "_")
        register_mjlab_task(
            task_id=f"Mjlab-Velocity-{_terrain}-Unitree-Go1{_suffix}",
            env_cfg=f"{_ENV_CFGS}:{_env_cfg}",
            rl_cfg=f"{_RL_CFG}:unitree_go1_ppo_runner_cfg",
            runner_cls=f"{_RUNNER}:VelocityOnPolicyRunner",
            profiles=_profiles,
        )

__getattr__ = lazy_names(
    __name__,
    {
        "VelocityOnPolicyRunner": _RUNNER,
        "unitree_go1_flat_env_cfg": _ENV_CFGS,
        "unitree_go1_flat_no_state_estimation_env_cfg": _ENV_CFGS,
        "unitree_go1_ppo_runner_cfg": _RL_CFG,
        "unitree_go1_rough_env_cfg": _ENV_CFGS,
        "unitree_go1_rough_no_state_estimation_env_cfg": _ENV_CFGS,
    },
)
