"""The Unitree Go1: its motors, gains, poses and collision setups.

Each joint is a position actuator, that is a spring and a damper towards the commanded angle. The
gains follow from the inertia I that the motor has at the joint (that of its rotor, times the square
of the gear ratio), as if the joint carried nothing else:

    stiffness = I w^2,  damping = 2 z I w,

with the natural frequency w (`NATURAL_FREQ`) and the damping ratio z (`DAMPING_RATIO`). Torques are
in N m, angles in rad, lengths in m.
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

# The model.

GO1_XML = Path(__file__).parent / "xmls" / "go1.xml"


def get_spec() -> mujoco.MjSpec:
    """Return a new spec of the robot, without actuators: the config adds them."""
    return mujoco.MjSpec.from_file(str(GO1_XML))


# Motors. Every joint has the same one; at the knee, a drive of 1.5 comes after its gear.

ROTOR_INERTIA = 0.000111842
"""Inertia of the rotor before the gear, kg m^2."""
HIP_GEAR_RATIO = 6
"""Gear of the hip and thigh joints."""
KNEE_GEAR_RATIO = HIP_GEAR_RATIO * 1.5
"""Gear of the calf joints."""

HIP_ACTUATOR = ElectricActuator(
    reflected_inertia=reflected_inertia(ROTOR_INERTIA, HIP_GEAR_RATIO),
    velocity_limit=30.1,
    effort_limit=23.7,
)
"""The motor as hip and thigh joints see it."""
KNEE_ACTUATOR = ElectricActuator(
    reflected_inertia=reflected_inertia(ROTOR_INERTIA, KNEE_GEAR_RATIO),
    velocity_limit=20.06,
    effort_limit=35.55,
)
"""The motor as calf joints see it."""

# Gains.

STIFFNESS_HIP, DAMPING_HIP = gains(HIP_ACTUATOR.reflected_inertia)
"""Gains of the hip and thigh joints, N m/rad and N m s/rad."""
STIFFNESS_KNEE, DAMPING_KNEE = gains(KNEE_ACTUATOR.reflected_inertia)
"""Gains of the calf joints, N m/rad and N m s/rad."""

GO1_HIP_ACTUATOR_CFG = position_actuator(HIP_ACTUATOR, (".*_hip_joint", ".*_thigh_joint"))
"""Actuators of the hip and thigh joints."""
GO1_KNEE_ACTUATOR_CFG = position_actuator(KNEE_ACTUATOR, (".*_calf_joint",))
"""Actuators of the calf joints."""
_ACTUATORS = (GO1_HIP_ACTUATOR_CFG, GO1_KNEE_ACTUATOR_CFG)
GO1_ARTICULATION = EntityArticulationInfoCfg(actuators=_ACTUATORS, soft_joint_pos_limit_factor=0.9)
"""All actuators."""

GO1_ACTION_SCALE = action_scale(_ACTUATORS)
"""Scale of joint position actions by joint pattern, rad per unit of action."""

# The home keyframe.

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
"""Standing with bent knees. The feet are 1.6 cm below the ground: resets of the velocity tasks lift
the robot by 1 to 5 cm, and under its weight the legs give way."""

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
"""Everything collides, the robot with itself too. Contacts that no foot is part of have no friction,
unless the other thing brings it."""
FEET_ONLY_COLLISION = CollisionCfg(
    geom_names_expr=(_FOOT_REGEX,),
    contype=0,
    conaffinity=1,
    condim=3,
    priority=1,
    friction=(0.6,),
    solimp=(0.9, 0.95, 0.023),
)
"""Only feet collide, and only with other things."""

# The robot.


def get_go1_robot_cfg() -> EntityCfg:
    """Return a new config of the robot, standing, with full collisions.

    It shares nothing with the constants of this module: what a task changes in it stays there.
    """
    return EntityCfg(
        init_state=copy.deepcopy(INIT_STATE),
        collisions=(copy.deepcopy(FULL_COLLISION),),
        spec_fn=get_spec,
        articulation=copy.deepcopy(GO1_ARTICULATION),
    )


__getattr__ = older_names(__name__)
