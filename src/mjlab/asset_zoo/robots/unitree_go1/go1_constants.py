"""Unitree Go1: motors, gains, keyframe and collision setups.

Each joint has a position actuator: a spring and damper toward the position target. The gains follow
from the reflected inertia I of the motor (rotor inertia times squared gear ratio), neglecting the
inertia of the links:

    stiffness = I w^2,  damping = 2 z I w,

with natural frequency w (`NATURAL_FREQ`) and damping ratio z (`DAMPING_RATIO`). Units: N m, rad, m.
"""

from __future__ import annotations

import copy
from pathlib import Path

import mujoco

from mjlab.asset_zoo.robots.motors import DAMPING_RATIO as DAMPING_RATIO
from mjlab.asset_zoo.robots.motors import NATURAL_FREQ as NATURAL_FREQ
from mjlab.asset_zoo.robots.motors import action_scale, gains, position_actuator
from mjlab.compat import older_names
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.utils.actuator import ElectricActuator, reflected_inertia
from mjlab.utils.spec_config import CollisionCfg

# Model.

GO1_XML = Path(__file__).parent / "xmls" / "go1.xml"


def get_spec() -> mujoco.MjSpec:
    """Return a new spec of the robot without actuators; the config adds actuators."""
    return mujoco.MjSpec.from_file(str(GO1_XML))


# Motors. All joints have the same motor; the knee has an additional 1.5:1 stage.

ROTOR_INERTIA = 0.000111842
"""Rotor inertia, before the gear (kg m^2)."""
HIP_GEAR_RATIO = 6
"""Gear ratio of the hip and thigh joints."""
KNEE_GEAR_RATIO = HIP_GEAR_RATIO * 1.5
"""Gear ratio of the calf joints."""

HIP_ACTUATOR = ElectricActuator(
    reflected_inertia=reflected_inertia(ROTOR_INERTIA, HIP_GEAR_RATIO),
    velocity_limit=30.1,
    effort_limit=23.7,
)
"""Motor properties at hip and thigh joints."""
KNEE_ACTUATOR = ElectricActuator(
    reflected_inertia=reflected_inertia(ROTOR_INERTIA, KNEE_GEAR_RATIO),
    velocity_limit=20.06,
    effort_limit=35.55,
)
"""Motor properties at calf joints."""

# Gains.

STIFFNESS_HIP, DAMPING_HIP = gains(HIP_ACTUATOR.reflected_inertia)
"""Gains of the hip and thigh joints (N m/rad, N m s/rad)."""
STIFFNESS_KNEE, DAMPING_KNEE = gains(KNEE_ACTUATOR.reflected_inertia)
"""Gains of the calf joints (N m/rad, N m s/rad)."""

GO1_HIP_ACTUATOR_CFG = position_actuator(HIP_ACTUATOR, (".*_hip_joint", ".*_thigh_joint"))
"""Actuators of the hip and thigh joints."""
GO1_KNEE_ACTUATOR_CFG = position_actuator(KNEE_ACTUATOR, (".*_calf_joint",))
"""Actuators of the calf joints."""
_ACTUATORS = (GO1_HIP_ACTUATOR_CFG, GO1_KNEE_ACTUATOR_CFG)
GO1_ARTICULATION = EntityArticulationInfoCfg(actuators=_ACTUATORS, soft_joint_pos_limit_factor=0.9)
"""All actuators."""

GO1_ACTION_SCALE = action_scale(_ACTUATORS)
"""Scale of joint position actions by joint pattern (rad per unit action)."""

# Home keyframe.

INIT_STATE = EntityCfg.InitialStateCfg(
    pos=(0.0, 0.0, 0.278),
    joint_pos={
        ".*thigh_joint": 0.9,
        ".*calf_joint": -1.8,
        ".*R_hip_joint": 0.1,
        ".*L_hip_joint": -0.1,
    },
    joint_vel={".*": 0.0},
)
"""Home keyframe: bent knees. The feet are 1.6 cm below the ground, because resets of the velocity
tasks raise the robot by 1 to 5 cm, and the legs yield under its weight."""

# Collision setups.

_FOOT_REGEX = r"^[FR][LR]_foot_collision$"

FULL_COLLISION = CollisionCfg(
    geom_names_expr=(r".*_collision\d*",),
    contype=1,
    conaffinity=1,
    condim={_FOOT_REGEX: 6, r".*_collision\d*": 1},
    priority={_FOOT_REGEX: 1, ".*": 0},
    friction={_FOOT_REGEX: (1, 5e-3, 5e-4)},
    solref=(0.01, 1),
)
"""All geoms collide, self-collisions included. Contacts without a foot are frictionless (condim 1),
unless the other geom has a larger condim."""
FEET_ONLY_COLLISION = CollisionCfg(
    geom_names_expr=(_FOOT_REGEX,),
    contype=0,
    conaffinity=1,
    condim=3,
    priority=1,
    friction=(0.6,),
    solimp=(0.9, 0.95, 0.023),
)
"""Only feet collide, without self-collisions."""

# Entity config.


def get_go1_robot_cfg() -> EntityCfg:
    """Return a new config of the robot, standing, with full collision.

    The config shares no objects with this module's constants, so tasks may modify it.
    """
    return EntityCfg(
        init_state=copy.deepcopy(INIT_STATE),
        collisions=(copy.deepcopy(FULL_COLLISION),),
        spec_fn=get_spec,
        articulation=copy.deepcopy(GO1_ARTICULATION),
    )


__getattr__ = older_names(__name__)
