"""I2RT YAM: motors, gains, keyframe and collision setups.

Each joint of the arm, and the left finger, has a position actuator: a spring and damper toward the
position target. The right finger has no actuator: the gripper's single motor moves both fingers,
coupled in the model by an equality constraint. The gains follow from the effective inertia I:

    stiffness = I w^2,  damping = 2 z I w,

with natural frequency w (`NATURAL_FREQ`, for the fingers `NATURAL_FREQ_GRIPPER`) and damping ratio z
(`DAMPING_RATIO`). For walking robots, I is the reflected inertia of the motor only; here I includes
all links moved by the joint, because the arm moves slowly and its motors are light. Units: N m, rad,
m, N.
"""

from __future__ import annotations

import copy
from pathlib import Path

import mujoco

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.asset_zoo.robots.motors import DAMPING_RATIO as DAMPING_RATIO
from mjlab.asset_zoo.robots.motors import action_scale, gains
from mjlab.compat import older_names
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.utils.actuator import ElectricActuator, reflect_rotary_to_linear
from mjlab.utils.spec_config import CollisionCfg

# Model.

YAM_XML = Path(__file__).parent / "xmls" / "yam.xml"


def get_spec() -> mujoco.MjSpec:
    """Return a new spec of the robot without actuators; the config adds actuators."""
    return mujoco.MjSpec.from_file(str(YAM_XML))


# Motors. The manufacturer specifies the reflected inertia, after the gear.

ARMATURE_DM_4340 = 0.032
"""Reflected inertia of the motors of joints 1 to 3 (kg m^2)."""
ARMATURE_DM_4310 = 0.0018
"""Reflected inertia of the motors of joints 4 to 6 and of the gripper (kg m^2)."""

DM_4340 = ElectricActuator(
    reflected_inertia=ARMATURE_DM_4340, velocity_limit=10.0, effort_limit=28.0
)
"""Motor of joints 1 to 3."""
DM_4310 = ElectricActuator(
    reflected_inertia=ARMATURE_DM_4310, velocity_limit=30.0, effort_limit=10.0
)
"""Motor of joints 4 to 6, and of the gripper before its crank."""

# Gripper: a crank converts the motor angle to finger travel.

GRIPPER_LINEAR_STROKE_CRANK = 0.071
"""Stroke of the fingers (m)."""
GRIPPER_MOTOR_STROKE_CRANK = 2.7
"""Motor angle of the full stroke (rad)."""
GRIPPER_TRANSMISSION_RATIO_CRANK = GRIPPER_LINEAR_STROKE_CRANK / GRIPPER_MOTOR_STROKE_CRANK
"""Transmission ratio: finger travel per motor angle (m/rad)."""
(
    ARMATURE_DM_4310_LINEAR_CRANK,
    VELOCITY_LIMIT_DM_4310_LINEAR_CRANK,
    EFFORT_LIMIT_DM_4310_LINEAR_CRANK,
) = reflect_rotary_to_linear(
    DM_4310.reflected_inertia,
    DM_4310.velocity_limit,
    DM_4310.effort_limit,
    GRIPPER_TRANSMISSION_RATIO_CRANK,
)
"""Motor properties at the fingers (kg, m/s, N)."""
EFFORT_LIMIT_DM_4310_LINEAR_CRANK_SAFE = EFFORT_LIMIT_DM_4310_LINEAR_CRANK * 0.1
"""Force limit of the gripper (N): a tenth of the motor's maximum."""

# Gains.

NATURAL_FREQ = 2 * 2.0 * 3.1415926535
"""Natural frequency of the arm, 2 Hz (rad/s). Trained policies rely on this rounding of pi."""
NATURAL_FREQ_GRIPPER = 1 * 2.0 * 3.1415926535
"""Natural frequency of the fingers, 1 Hz (rad/s)."""

EFFECTIVE_INERTIAS = {
    "joint1": 0.123153,
    "joint2": 0.277411,
    "joint3": 0.232763,
    "joint4": 0.030154,
    "joint5": 0.009126,
    "joint6": 0.002868,
    "left_finger": 2.781624,
}
"""Effective inertia by joint: diagonal of the mass matrix at the home keyframe, including the motors'
reflected inertia (kg m^2; finger: kg)."""
STIFFNESS_GRIPPER, DAMPING_GRIPPER = gains(EFFECTIVE_INERTIAS["left_finger"], NATURAL_FREQ_GRIPPER)
"""Gains of the fingers (N/m, N s/m)."""


def _joint_actuator(joint: str, motor: ElectricActuator) -> BuiltinPositionActuatorCfg:
    stiffness, damping = gains(EFFECTIVE_INERTIAS[joint], NATURAL_FREQ)
    return BuiltinPositionActuatorCfg(
        target_names_expr=(joint,),
        stiffness=stiffness,
        damping=damping,
        effort_limit=motor.effort_limit,
        armature=motor.reflected_inertia,
    )


ARM_ACTUATORS = (
    *(_joint_actuator(f"joint{number}", DM_4340) for number in (1, 2, 3)),
    *(_joint_actuator(f"joint{number}", DM_4310) for number in (4, 5, 6)),
)
"""Actuators of the arm, one per joint."""
ACTUATOR_DM_4310_LINEAR_CRANK = BuiltinPositionActuatorCfg(
    target_names_expr=("left_finger",),
    stiffness=STIFFNESS_GRIPPER,
    damping=DAMPING_GRIPPER,
    effort_limit=EFFORT_LIMIT_DM_4310_LINEAR_CRANK_SAFE,
    armature=ARMATURE_DM_4310_LINEAR_CRANK,
)
"""Actuator of the gripper, on the left finger."""
ARTICULATION = EntityArticulationInfoCfg(
    actuators=(*ARM_ACTUATORS, ACTUATOR_DM_4310_LINEAR_CRANK), soft_joint_pos_limit_factor=0.9
)
"""All actuators."""

YAM_ACTION_SCALE = action_scale((*ARM_ACTUATORS, ACTUATOR_DM_4310_LINEAR_CRANK))
"""Scale of joint position actions by joint (rad per unit action; finger: m)."""

# Home keyframe.

HOME_KEYFRAME = EntityCfg.InitialStateCfg(
    pos=(0.0, 0.0, 0.01),
    joint_pos={
        "joint2": 1.047,
        "joint3": 1.05,
        "joint4": -0.9,
        # Half open.
        "left_finger": 0.0375 / 2,
        "right_finger": -0.0375 / 2,
    },
)
"""Home keyframe: level forearm, gripper half open, 21 cm above the ground and pointing down. The
base stands on the ground."""

# Collision setups.

_FINGERTIPS_REGEX = r"[lr]f_down(6|7|8|9|10|11)_collision"
_GRIPPER_REGEX = r"(link6|[lr]f)_.*_collision"
_ALL_REGEX = r".*_collision"


def _collision(contype: int | dict[str, int]) -> CollisionCfg:
    return CollisionCfg(
        geom_names_expr=(_ALL_REGEX,),
        contype=contype,
        conaffinity=copy.copy(contype),
        # Fingertips grasp objects: friction with priority, including torsional and rolling friction.
        condim={_FINGERTIPS_REGEX: 6, _ALL_REGEX: 3},
        priority={_FINGERTIPS_REGEX: 1, ".*": 0},
        friction={_FINGERTIPS_REGEX: (1, 5e-3, 5e-4), _ALL_REGEX: (0.6,)},
        solref={_FINGERTIPS_REGEX: (0.01, 1)},
    )


FULL_COLLISION = _collision(1)
"""All geoms collide, self-collisions included."""
GRIPPER_ONLY_COLLISION = _collision({_GRIPPER_REGEX: 1, _ALL_REGEX: 0})
"""Only gripper geoms collide."""

# Entity config.


def get_yam_robot_cfg() -> EntityCfg:
    """Return a new config of the robot at its home keyframe, with gripper-only collision.

    The config shares no objects with this module's constants, so tasks may modify it.
    """
    return EntityCfg(
        init_state=copy.deepcopy(HOME_KEYFRAME),
        collisions=(copy.deepcopy(GRIPPER_ONLY_COLLISION),),
        spec_fn=get_spec,
        articulation=copy.deepcopy(ARTICULATION),
    )


__getattr__ = older_names(__name__)
