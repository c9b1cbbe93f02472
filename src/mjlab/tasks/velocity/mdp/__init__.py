"""The terms of the velocity task, together with the library of `mjlab.envs.mdp`."""

from mjlab.compat import older_exports, older_names
from mjlab.envs.mdp import *  # noqa: F403
from mjlab.envs.mdp import __all__ as _library
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from mjlab.sensor import ContactSensor, RayCastSensor, TerrainHeightSensor
from mjlab.tasks.velocity.mdp.curriculums import VelocityStage, commands_vel, terrain_levels_vel
from mjlab.tasks.velocity.mdp.gait import (
    GaitClockCommand,
    GaitClockCommandCfg,
    feet_apart_l2,
    feet_height_by_phase,
    feet_tilt,
    height_over_feet,
    root_height_l2,
    root_near_feet,
    weighted_joint_deviation,
)
from mjlab.tasks.velocity.mdp.observations import (
    foot_air_time,
    foot_contact,
    foot_contact_forces,
    foot_height,
)
from mjlab.tasks.velocity.mdp.rewards import (
    angular_momentum_penalty,
    body_angular_velocity_penalty,
    feet_air_time,
    feet_clearance,
    feet_slip,
    feet_swing_height,
    self_collision_cost,
    soft_landing,
    track_angular_velocity,
    track_linear_velocity,
    upright,
    variable_posture,
)
from mjlab.tasks.velocity.mdp.stepping import SteppingGains, stepping_action
from mjlab.tasks.velocity.mdp.terminations import (
    illegal_contact,
    out_of_terrain_bounds,
    terrain_edge_reached,
)
from mjlab.tasks.velocity.mdp.terrain_utils import terrain_normal_from_sensors
from mjlab.tasks.velocity.mdp.velocity_command import (
    UniformVelocityCommand,
    UniformVelocityCommandCfg,
)

__all__ = [
    "CommandTerm",
    "CommandTermCfg",
    "ContactSensor",
    "GaitClockCommand",
    "GaitClockCommandCfg",
    "RayCastSensor",
    "SteppingGains",
    "TerrainHeightSensor",
    "UniformVelocityCommand",
    "UniformVelocityCommandCfg",
    "VelocityStage",
    "angular_momentum_penalty",
    "body_angular_velocity_penalty",
    "commands_vel",
    "feet_air_time",
    "feet_apart_l2",
    "feet_clearance",
    "feet_height_by_phase",
    "feet_slip",
    "feet_swing_height",
    "feet_tilt",
    "foot_air_time",
    "foot_contact",
    "foot_contact_forces",
    "foot_height",
    "height_over_feet",
    "illegal_contact",
    "out_of_terrain_bounds",
    "root_height_l2",
    "root_near_feet",
    "self_collision_cost",
    "stepping_action",
    "soft_landing",
    "terrain_edge_reached",
    "terrain_levels_vel",
    "terrain_normal_from_sensors",
    "track_angular_velocity",
    "track_linear_velocity",
    "upright",
    "variable_posture",
    "weighted_joint_deviation",
    *(name for name in _library if name != "RayCastSensor"),
    *older_exports(__name__),
]

__getattr__ = older_names(__name__)
