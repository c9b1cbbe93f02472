"""Unitree G1: motors, gains, keyframes and collision setups.

Each joint has a position actuator: a spring and damper toward the position target. The gains follow
from the reflected inertia I of the motor (rotor and two planetary stages), neglecting the inertia of
the links:

    stiffness = I w^2,  damping = 2 z I w,

with natural frequency w (`NATURAL_FREQ`) and damping ratio z (`DAMPING_RATIO`). Four motor types
drive the 29 joints. Motors are named after their size; "7520-14" is the 7520 with a gear ratio of
about 14:1. Units: N m, rad, m, kg m^2.
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
from mjlab.utils.actuator import ElectricActuator, reflected_inertia_from_two_stage_planetary
from mjlab.utils.spec_config import CollisionCfg

# Model.

G1_XML = Path(__file__).parent / "xmls" / "g1.xml"


def get_spec() -> mujoco.MjSpec:
    """Return a new spec of the robot without actuators; the config adds actuators."""
    return mujoco.MjSpec.from_file(str(G1_XML))


# Motors: inertias of rotor, first and second stage, and gear ratios of the stages. A planetary stage
# with s sun teeth and r ring teeth has ratio 1 + r/s.

ROTOR_INERTIAS_5020 = (0.139e-4, 0.017e-4, 0.169e-4)
GEARS_5020 = (1, 1 + (46 / 18), 1 + (56 / 16))
ARMATURE_5020 = reflected_inertia_from_two_stage_planetary(ROTOR_INERTIAS_5020, GEARS_5020)

ROTOR_INERTIAS_7520_14 = (0.489e-4, 0.098e-4, 0.533e-4)
GEARS_7520_14 = (1, 4.5, 1 + (48 / 22))
ARMATURE_7520_14 = reflected_inertia_from_two_stage_planetary(ROTOR_INERTIAS_7520_14, GEARS_7520_14)

ROTOR_INERTIAS_7520_22 = (0.489e-4, 0.109e-4, 0.738e-4)
GEARS_7520_22 = (1, 4.5, 5)
ARMATURE_7520_22 = reflected_inertia_from_two_stage_planetary(ROTOR_INERTIAS_7520_22, GEARS_7520_22)

ROTOR_INERTIAS_4010 = (0.068e-4, 0.0, 0.0)
GEARS_4010 = (1, 5, 5)
ARMATURE_4010 = reflected_inertia_from_two_stage_planetary(ROTOR_INERTIAS_4010, GEARS_4010)

ACTUATOR_5020 = ElectricActuator(
    reflected_inertia=ARMATURE_5020, velocity_limit=37.0, effort_limit=25.0
)
"""Motor of shoulders, elbow and wrist roll. Ankle, and waist pitch and roll, have two motors
each."""
ACTUATOR_7520_14 = ElectricActuator(
    reflected_inertia=ARMATURE_7520_14, velocity_limit=32.0, effort_limit=88.0
)
"""Motor of hip pitch and yaw, and waist yaw."""
ACTUATOR_7520_22 = ElectricActuator(
    reflected_inertia=ARMATURE_7520_22, velocity_limit=20.0, effort_limit=139.0
)
"""Motor of hip roll and knee."""
ACTUATOR_4010 = ElectricActuator(
    reflected_inertia=ARMATURE_4010, velocity_limit=22.0, effort_limit=5.0
)
"""Motor of wrist pitch and yaw."""

# Gains.

STIFFNESS_5020, DAMPING_5020 = gains(ARMATURE_5020)
STIFFNESS_7520_14, DAMPING_7520_14 = gains(ARMATURE_7520_14)
STIFFNESS_7520_22, DAMPING_7520_22 = gains(ARMATURE_7520_22)
STIFFNESS_4010, DAMPING_4010 = gains(ARMATURE_4010)

G1_ACTUATOR_5020 = position_actuator(
    ACTUATOR_5020,
    (
        ".*_elbow_joint",
        ".*_shoulder_pitch_joint",
        ".*_shoulder_roll_joint",
        ".*_shoulder_yaw_joint",
        ".*_wrist_roll_joint",
    ),
)
G1_ACTUATOR_7520_14 = position_actuator(
    ACTUATOR_7520_14, (".*_hip_pitch_joint", ".*_hip_yaw_joint", "waist_yaw_joint")
)
G1_ACTUATOR_7520_22 = position_actuator(ACTUATOR_7520_22, (".*_hip_roll_joint", ".*_knee_joint"))
G1_ACTUATOR_4010 = position_actuator(ACTUATOR_4010, (".*_wrist_pitch_joint", ".*_wrist_yaw_joint"))

# Waist and ankle are four-bar linkages: two parallel 5020 motors move pitch when turning in the same
# direction and roll when turning in opposite directions. The model uses a serial chain instead. At
# the nominal pose, both motors act on each of its two joints, hence twice the inertia, gains and
# torque; away from it, the true values depend on the angles.
G1_ACTUATOR_WAIST = position_actuator(
    ACTUATOR_5020, ("waist_pitch_joint", "waist_roll_joint"), motors=2
)
G1_ACTUATOR_ANKLE = position_actuator(
    ACTUATOR_5020, (".*_ankle_pitch_joint", ".*_ankle_roll_joint"), motors=2
)

_ACTUATORS = (
    G1_ACTUATOR_5020,
    G1_ACTUATOR_7520_14,
    G1_ACTUATOR_7520_22,
    G1_ACTUATOR_4010,
    G1_ACTUATOR_WAIST,
    G1_ACTUATOR_ANKLE,
)
G1_ARTICULATION = EntityArticulationInfoCfg(actuators=_ACTUATORS, soft_joint_pos_limit_factor=0.9)
"""All actuators."""

G1_ACTION_SCALE = action_scale(_ACTUATORS)
"""Scale of joint position actions by joint pattern (rad per unit action)."""

# Keyframes.

HOME_KEYFRAME = EntityCfg.InitialStateCfg(
    pos=(0, 0, 0.783675),
    joint_pos={
        ".*_hip_pitch_joint": -0.1,
        ".*_knee_joint": 0.3,
        ".*_ankle_pitch_joint": -0.2,
        ".*_shoulder_pitch_joint": 0.2,
        ".*_elbow_joint": 1.28,
        "left_shoulder_roll_joint": 0.2,
        "right_shoulder_roll_joint": -0.2,
    },
    joint_vel={".*": 0.0},
)
"""Home keyframe: nearly upright, arms hanging."""
KNEES_BENT_KEYFRAME = EntityCfg.InitialStateCfg(
    pos=(0, 0, 0.76),
    joint_pos={
        ".*_hip_pitch_joint": -0.312,
        ".*_knee_joint": 0.669,
        ".*_ankle_pitch_joint": -0.363,
        ".*_elbow_joint": 0.6,
        "left_shoulder_roll_joint": 0.2,
        "left_shoulder_pitch_joint": 0.2,
        "right_shoulder_roll_joint": -0.2,
        "right_shoulder_pitch_joint": 0.2,
    },
    joint_vel={".*": 0.0},
)
"""Keyframe with bent knees, for walking."""

# Collision setups.

_FOOT_REGEX = r"^(left|right)_foot[1-7]_collision$"

FULL_COLLISION = CollisionCfg(
    geom_names_expr=(".*_collision",),
    contype=1,
    conaffinity=1,
    condim={_FOOT_REGEX: 3, ".*_collision": 1},
    priority={_FOOT_REGEX: 1, ".*": 0},
    friction={_FOOT_REGEX: (0.6,)},
)
"""All geoms collide, self-collisions included. Only feet have friction."""
FULL_COLLISION_WITHOUT_SELF = CollisionCfg(
    geom_names_expr=(".*_collision",),
    contype=0,
    conaffinity=1,
    condim={_FOOT_REGEX: 3, ".*_collision": 1},
    priority={_FOOT_REGEX: 1, ".*": 0},
    friction={_FOOT_REGEX: (0.6,)},
)
"""All geoms collide, without self-collisions."""
FEET_ONLY_COLLISION = CollisionCfg(
    geom_names_expr=(_FOOT_REGEX,),
    contype=0,
    conaffinity=1,
    condim=3,
    priority=1,
    friction=(0.6,),
)
"""Only feet collide, without self-collisions."""

# Entity config.


def get_g1_robot_cfg() -> EntityCfg:
    """Return a new config of the robot with bent knees and full collision.

    The config shares no objects with this module's constants, so tasks may modify it.
    """
    return EntityCfg(
        init_state=copy.deepcopy(KNEES_BENT_KEYFRAME),
        collisions=(copy.deepcopy(FULL_COLLISION),),
        spec_fn=get_spec,
        articulation=copy.deepcopy(G1_ARTICULATION),
    )


__getattr__ = older_names(__name__)
