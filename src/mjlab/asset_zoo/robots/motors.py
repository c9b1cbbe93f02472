"""Position actuators from motor parameters.

A position actuator is a spring and damper toward the position target. Its gains follow from the
reflected inertia I of the motor, neglecting the inertia of the links:

    stiffness = I w^2,  damping = 2 z I w,

with natural frequency w (`NATURAL_FREQ`) and damping ratio z (`DAMPING_RATIO`). Units: N m, rad,
kg m^2.
"""

from __future__ import annotations

from collections.abc import Iterable

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.utils.actuator import ElectricActuator

NATURAL_FREQ = 10 * 2.0 * 3.1415926535
"""Natural frequency of the joints, 10 Hz (rad/s). Trained policies rely on this rounding of pi."""
DAMPING_RATIO = 2.0
"""Damping ratio of the joints. Above 1: overdamped, no overshoot."""


def position_actuator(
    motor: ElectricActuator, joints: tuple[str, ...], motors: int = 1
) -> BuiltinPositionActuatorCfg:
    """Return the actuator of `joints` (patterns), with `motors` equal motors per joint."""
    stiffness, damping = gains(motor.reflected_inertia)
    return BuiltinPositionActuatorCfg(
        target_names_expr=joints,
        stiffness=stiffness * motors,
        damping=damping * motors,
        effort_limit=motor.effort_limit * motors,
        armature=motor.reflected_inertia * motors,
    )


def gains(inertia: float, natural_freq: float = NATURAL_FREQ) -> tuple[float, float]:
    """Return stiffness (N m/rad) and damping (N m s/rad) for an inertia at the joint."""
    return inertia * natural_freq**2, 2.0 * DAMPING_RATIO * inertia * natural_freq


def action_scale(actuators: Iterable[BuiltinPositionActuatorCfg]) -> dict[str, float]:
    """Return the scale of joint position actions (rad per unit action), by joint pattern.

    A unit action is a quarter of the position error effort_limit / stiffness.
    """
    return {
        pattern: 0.25 * actuator.effort_limit / actuator.stiffness
        for actuator in actuators
        if actuator.effort_limit is not None
        for pattern in actuator.target_names_expr
    }
