"""The terms of motion tracking, together with the library of `mjlab.envs.mdp`."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mjlab.compat import older_exports, older_names
from mjlab.envs.mdp import *  # noqa: F403
from mjlab.envs.mdp import __all__ as _library
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.sensor import ContactSensor
from mjlab.tasks.tracking.mdp.commands import MotionCommand, MotionCommandCfg, MotionLoader
from mjlab.tasks.tracking.mdp.metrics import (
    compute_ee_orientation_error,
    compute_ee_position_error,
    compute_joint_velocity_error,
    compute_mpkpe,
    compute_root_relative_mpkpe,
)
from mjlab.tasks.tracking.mdp.observations import (
    motion_anchor_ori_b,
    motion_anchor_pos_b,
    robot_body_ori_b,
    robot_body_pos_b,
)
from mjlab.tasks.tracking.mdp.rewards import (
    motion_global_anchor_orientation_error_exp,
    motion_global_anchor_position_error_exp,
    motion_global_body_angular_velocity_error_exp,
    motion_global_body_linear_velocity_error_exp,
    motion_relative_body_orientation_error_exp,
    motion_relative_body_position_error_exp,
    self_collision_cost,
)
from mjlab.tasks.tracking.mdp.terminations import (
    bad_anchor_ori,
    bad_anchor_pos,
    bad_anchor_pos_z_only,
    bad_motion_body_pos,
    bad_motion_body_pos_z_only,
    motion_ended,
)
from mjlab.utils.lab_api.math import subtract_frame_transforms

if TYPE_CHECKING:
    from mjlab.viewer.debug_visualizer import DebugVisualizer as DebugVisualizer

__all__ = [
    "CommandTerm",
    "CommandTermCfg",
    "ContactSensor",
    "DebugVisualizer",
    "MotionCommand",
    "MotionCommandCfg",
    "MotionLoader",
    "bad_anchor_ori",
    "bad_anchor_pos",
    "bad_anchor_pos_z_only",
    "bad_motion_body_pos",
    "bad_motion_body_pos_z_only",
    "compute_ee_orientation_error",
    "compute_ee_position_error",
    "compute_joint_velocity_error",
    "compute_mpkpe",
    "compute_root_relative_mpkpe",
    "motion_anchor_ori_b",
    "motion_anchor_pos_b",
    "motion_ended",
    "motion_global_anchor_orientation_error_exp",
    "motion_global_anchor_position_error_exp",
    "motion_global_body_angular_velocity_error_exp",
    "motion_global_body_linear_velocity_error_exp",
    "motion_relative_body_orientation_error_exp",
    "motion_relative_body_position_error_exp",
    "robot_body_ori_b",
    "robot_body_pos_b",
    "self_collision_cost",
    "subtract_frame_transforms",
    *(name for name in _library if name != "DebugVisualizer"),
    *older_exports(__name__),
]

_older_name = older_names(__name__)

# A name of 1.6 at this path, which is loaded when it is asked for.
_LAZY = {"DebugVisualizer": "mjlab.viewer.debug_visualizer"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    return _older_name(name)
