"""The library of reusable terms: observations, rewards, terminations, events, actions, ...

Domain randomization is in `mjlab.envs.mdp.dr`.
"""

from __future__ import annotations

import importlib
from typing import Any

from mjlab.compat import older_exports, older_names
from mjlab.entity import Entity
from mjlab.envs.mdp import dr
from mjlab.envs.mdp.actions import *  # noqa: F403
from mjlab.envs.mdp.actions import __all__ as _action_names
from mjlab.envs.mdp.curriculums import (
    RewardCurriculumStage,
    TerminationCurriculumStage,
    reward_curriculum,
    termination_curriculum,
)
from mjlab.envs.mdp.events import (
    apply_body_impulse,
    apply_external_force_torque,
    push_by_setting_velocity,
    randomize_terrain,
    reset_joints_by_offset,
    reset_root_state_from_flat_patches,
    reset_root_state_uniform,
    reset_scene_to_default,
    resolve_env_ids,
)
from mjlab.envs.mdp.metrics import (
    mean_action_acc,
)
from mjlab.envs.mdp.observations import (
    base_ang_vel,
    base_lin_vel,
    builtin_sensor,
    generated_commands,
    height_scan,
    joint_pos_rel,
    joint_vel_rel,
    last_action,
    projected_gravity,
    projected_gravity_from_sensor,
)
from mjlab.envs.mdp.rewards import (
    action_acc_l2,
    action_rate_l2,
    electrical_power_cost,
    flat_orientation_l2,
    is_alive,
    is_terminated,
    joint_acc_l2,
    joint_pos_limits,
    joint_torques_l2,
    joint_vel_l2,
    posture,
)
from mjlab.envs.mdp.terminations import (
    bad_orientation,
    nan_detection,
    root_height_below_minimum,
    time_out,
)
from mjlab.managers.reward_manager import (
    RewardTermCfg,
)
from mjlab.managers.scene_entity_config import (
    SceneEntityCfg,
)
from mjlab.sensor.builtin_sensor import (
    BuiltinSensor,
)
from mjlab.sensor.raycast_sensor import (
    RayCastSensor,
)
from mjlab.utils.lab_api.math import (
    sample_uniform,
)
from mjlab.utils.lab_api.string import (
    resolve_matching_names_values,
)
from mjlab.utils.nan_guard import (
    NanGuard,
)

__all__ = [
    "BuiltinSensor",
    "Entity",
    "NanGuard",
    "RayCastSensor",
    "RewardCurriculumStage",
    "RewardTermCfg",
    "SceneEntityCfg",
    "TerminationCurriculumStage",
    "action_acc_l2",
    "action_rate_l2",
    "apply_body_impulse",
    "apply_external_force_torque",
    "bad_orientation",
    "base_ang_vel",
    "base_lin_vel",
    "builtin_sensor",
    "dr",
    "electrical_power_cost",
    "flat_orientation_l2",
    "generated_commands",
    "height_scan",
    "is_alive",
    "is_terminated",
    "joint_acc_l2",
    "joint_pos_limits",
    "joint_pos_rel",
    "joint_torques_l2",
    "joint_vel_l2",
    "joint_vel_rel",
    "last_action",
    "mean_action_acc",
    "nan_detection",
    "posture",
    "projected_gravity",
    "projected_gravity_from_sensor",
    "push_by_setting_velocity",
    "randomize_terrain",
    "reset_joints_by_offset",
    "reset_root_state_from_flat_patches",
    "reset_root_state_uniform",
    "reset_scene_to_default",
    "resolve_env_ids",
    "resolve_matching_names_values",
    "reward_curriculum",
    "root_height_below_minimum",
    "sample_uniform",
    "termination_curriculum",
    "time_out",
    *_action_names,
    *older_exports(__name__),
]

_older_name = older_names(__name__)

# Loaded when asked for: few tasks cast rays.
_LAZY = {"RayCastSensor": "mjlab.sensor"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    return _older_name(name)
