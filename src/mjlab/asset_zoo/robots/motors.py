"""Position actuators from the figures of the motors that move the joints.

A position actuator is a spring and a damper towards the commanded angle. Its gains follow from the
inertia I that the motor has at the joint, as if the joint carried nothing else:

    stiffness = I w^2,  damping = 2 z I w,

with the natural frequency w (`NATURAL_FREQ`) and the damping ratio z (`DAMPING_RATIO`). Torques are
in N m, angles in rad, inertias in kg m^2.
"""

from __future__ import annotations

from collections.abc import Iterable

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.utils.actuator import ElectricActuator

NATURAL_FREQ = 10 * 2.0 * 3.1415926535
"""Natural frequency of the joints, 10 Hz in rad/s. (Policies are trained with pi as it is here.)"""
DAMPING_RATIO = 2.0
"""Damping ratio of the joints; more than 1 creeps towards the target and never overshoots."""


def position_actuator(
    motor: ElectricActuator, joints: tuple[str, ...], motors: int = 1
) -> BuiltinPositionActuatorCfg:
    """Return the actuator of `joints` (patterns), each of which `motors` equal motors move."""
    stiffness, damping = gains(motor.reflected_inertia)
    return BuiltinPositionActuatorCfg(
        target_names_expr=joints,
        stiffness=stiffness * motors,
        damping=damping * motors,
        effort_limit=motor.effort_limit * motors,
        armature=motor.reflected_inertia * motors,
    )


def gains(inertia: float, natural_freq: float = NATURAL_FREQ) -> tuple[float, float]:
    """Return stiffness, N m/rad, and damping, N m s/rad, for an inertia at the joint."""
    return inertia * natural_freq**2, 2.0 * DAMPING_RATIO * inertia * natural_freq


def action_scale(actuators: Iterable[BuiltinPositionActuatorCfg]) -> dict[str, float]:
    """Return the scale of joint position actions by joint pattern, rad per unit of action.

    An action of one is a quarter of the angle at which the spring alone gives the effort limit.
    """
    return {
        pattern: 0.25 * actuator.effort_limit / actuator.stiffness
        for actuator in actuators
        if actuator.effort_limit is not None
        for pattern in actuator.target_names_expr
    }
