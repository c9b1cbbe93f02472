"""The terms of the manipulation tasks, together with the library of `mjlab.envs.mdp`."""

from mjlab.compat import older_exports, older_names
from mjlab.envs.mdp import *  # noqa: F403
from mjlab.envs.mdp import __all__ as _library
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.sensor import CameraSensor, ContactSensor
from mjlab.tasks.manipulation.mdp.commands import (
    LiftingCommand,
    LiftingCommandCfg,
    MultiCubeLiftingCommand,
    MultiCubeLiftingCommandCfg,
)
from mjlab.tasks.manipulation.mdp.observations import (
    camera_depth,
    camera_rgb,
    camera_segmentation,
    camera_target_cube_mask,
    ee_to_object_distance,
    ee_velocity,
    object_to_goal_distance,
    target_position,
)
from mjlab.tasks.manipulation.mdp.rewards import (
    bring_object_reward,
    joint_velocity_hinge_penalty,
    multi_cube_bring_object_reward,
    multi_cube_staged_position_reward,
    staged_position_reward,
)
from mjlab.tasks.manipulation.mdp.terminations import illegal_contact

__all__ = [
    "CameraSensor",
    "CommandTerm",
    "CommandTermCfg",
    "ContactSensor",
    "LiftingCommand",
    "LiftingCommandCfg",
    "MultiCubeLiftingCommand",
    "MultiCubeLiftingCommandCfg",
    "bring_object_reward",
    "camera_depth",
    "camera_rgb",
    "camera_segmentation",
    "camera_target_cube_mask",
    "ee_to_object_distance",
    "ee_velocity",
    "illegal_contact",
    "joint_velocity_hinge_penalty",
    "multi_cube_bring_object_reward",
    "multi_cube_staged_position_reward",
    "object_to_goal_distance",
    "staged_position_reward",
    "target_position",
    *_library,
    *older_exports(__name__),
]

__getattr__ = older_names(__name__)
