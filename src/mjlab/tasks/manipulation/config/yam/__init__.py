"""Registration of the YAM arm's manipulation tasks. Names are imported on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.tasks.registry import register_mjlab_task as register_mjlab_task
from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.tasks.manipulation.config.yam.env_cfgs import (
        yam_lift_cube_env_cfg as yam_lift_cube_env_cfg,
    )
    from mjlab.tasks.manipulation.config.yam.env_cfgs import (
        yam_lift_cube_vision_env_cfg as yam_lift_cube_vision_env_cfg,
    )
    from mjlab.tasks.manipulation.config.yam.env_cfgs import (
        yam_multi_cube_seg_env_cfg as yam_multi_cube_seg_env_cfg,
    )
    from mjlab.tasks.manipulation.config.yam.rl_cfg import (
        yam_lift_cube_ppo_runner_cfg as yam_lift_cube_ppo_runner_cfg,
    )
    from mjlab.tasks.manipulation.config.yam.rl_cfg import (
        yam_lift_cube_vision_ppo_runner_cfg as yam_lift_cube_vision_ppo_runner_cfg,
    )
    from mjlab.tasks.manipulation.config.yam.rl_cfg import (
        yam_multi_cube_seg_ppo_runner_cfg as yam_multi_cube_seg_ppo_runner_cfg,
    )
    from mjlab.tasks.manipulation.rl import (
        ManipulationOnPolicyRunner as ManipulationOnPolicyRunner,
    )

_ENV_CFGS = "mjlab.tasks.manipulation.config.yam.env_cfgs"
_RL_CFG = "mjlab.tasks.manipulation.config.yam.rl_cfg"
_RUNNER = "mjlab.tasks.manipulation.rl"
_PROFILES = "mjlab.tasks.manipulation.config.yam.rl_cfg"

_OF_STATE = {"cpu": f"{_PROFILES}:cpu"}
_OF_IMAGES = {"cpu": f"{_PROFILES}:cpu_vision", "student": f"{_PROFILES}:student"}

# Task: environment config, runner config, profiles.
for _task, (_env, _rl, _profiles) in {
    "Mjlab-Lift-Cube-Yam": ("lift_cube", "lift_cube", _OF_STATE),
    "Mjlab-Lift-Cube-Yam-Rgb": ("lift_cube_rgb", "lift_cube_vision", _OF_IMAGES),
    "Mjlab-Lift-Cube-Yam-Depth": ("lift_cube_depth", "lift_cube_vision", _OF_IMAGES),
    "Mjlab-Multi-Cube-Seg-Yam": ("multi_cube_seg", "multi_cube_seg", _OF_IMAGES),
}.items():
    register_mjlab_task(
        task_id=_task,
        env_cfg=f"{_ENV_CFGS}:yam_{_env}_env_cfg",
        rl_cfg=f"{_RL_CFG}:yam_{_rl}_ppo_runner_cfg",
        runner_cls=f"{_RUNNER}:ManipulationOnPolicyRunner",
        profiles=_profiles,
    )

__getattr__ = lazy_names(
    __name__,
    {
        "ManipulationOnPolicyRunner": _RUNNER,
        "yam_lift_cube_env_cfg": _ENV_CFGS,
        "yam_lift_cube_ppo_runner_cfg": _RL_CFG,
        "yam_lift_cube_vision_env_cfg": _ENV_CFGS,
        "yam_lift_cube_vision_ppo_runner_cfg": _RL_CFG,
        "yam_multi_cube_seg_env_cfg": _ENV_CFGS,
        "yam_multi_cube_seg_ppo_runner_cfg": _RL_CFG,
    },
)
