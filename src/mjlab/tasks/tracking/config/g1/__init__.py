"""Registration of Unitree G1 motion tracking. Names are imported on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.tasks.registry import register_mjlab_task as register_mjlab_task
from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.tasks.tracking.config.g1.env_cfgs import (
        unitree_g1_flat_tracking_env_cfg as unitree_g1_flat_tracking_env_cfg,
    )
    from mjlab.tasks.tracking.config.g1.rl_cfg import (
        unitree_g1_tracking_ppo_runner_cfg as unitree_g1_tracking_ppo_runner_cfg,
    )
    from mjlab.tasks.tracking.rl import (
        MotionTrackingOnPolicyRunner as MotionTrackingOnPolicyRunner,
    )

_ENV_CFGS = "mjlab.tasks.tracking.config.g1.env_cfgs"
_RL_CFG = "mjlab.tasks.tracking.config.g1.rl_cfg"
_RUNNER = "mjlab.tasks.tracking.rl"

for _suffix, _env_cfg in (
    ("", "unitree_g1_flat_tracking_env_cfg"),
    ("-No-State-Estimation", "unitree_g1_flat_tracking_no_state_estimation_env_cfg"),
):
    register_mjlab_task(
        task_id=f"Mjlab-Tracking-Flat-Unitree-G1{_suffix}",
        env_cfg=f"{_ENV_CFGS}:{_env_cfg}",
        rl_cfg=f"{_RL_CFG}:unitree_g1_tracking_ppo_runner_cfg",
        runner_cls=f"{_RUNNER}:MotionTrackingOnPolicyRunner",
        profiles={"cpu": "mjlab.tasks.tracking.config.g1.rl_cfg:cpu"},
        options="mjlab.tasks.tracking.options:MotionOptions",
    )

__getattr__ = lazy_names(
    __name__,
    {
        "MotionTrackingOnPolicyRunner": _RUNNER,
        "unitree_g1_flat_tracking_env_cfg": _ENV_CFGS,
        "unitree_g1_tracking_ppo_runner_cfg": _RL_CFG,
    },
)
