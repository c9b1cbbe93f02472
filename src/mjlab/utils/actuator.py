"""Electric motor and gear formulas, in SI units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple


@dataclass
class ElectricActuator:
    """Motor properties at the joint, after the gear."""

    reflected_inertia: float
    """Reflected rotor inertia at the joint (kg m^2)."""
    velocity_limit: float
    """Maximum speed (rad/s)."""
    effort_limit: float
    """Maximum torque (N m)."""


class LinearJointProperties(NamedTuple):
    """Rotary motor properties at a slide joint."""

    armature: float
    """Reflected mass (kg)."""
    velocity_limit: float
    """Maximum speed (m/s)."""
    effort_limit: float
    """Maximum force (N)."""


def reflected_inertia(rotor_inertia: float, gear_ratio: float) -> float:
    """Return the reflected rotor inertia after a gear: J G^2."""
    return rotor_inertia * gear_ratio**2


def reflected_inertia_from_two_stage_planetary(
    rotor_inertia: tuple[float, float, float], gear_ratio: tuple[float, float, float]
) -> float:
    """Return the reflected inertia after two planetary stages: J0 (G1 G2)^2 + J1 G2^2 + J2.

    Args:
        rotor_inertia: (J0, J1, J2), of rotor, first and second stage, kg m^2.
        gear_ratio: (1, G1, G2).

    Raises `ValueError` unless the first ratio is 1.
    """
    if gear_ratio[0] != 1:
        raise ValueError(f"gear_ratio[0]: expected 1 (the rotor itself), got {gear_ratio[0]}.")
    _, first, second = gear_ratio
    rotor, stage_1, stage_2 = rotor_inertia
    return reflected_inertia(rotor, first * second) + reflected_inertia(stage_1, second) + stage_2


def rpm_to_rad(rpm: float) -> float:
    """Convert revolutions per minute to rad/s."""
    return rpm * 2.0 * math.pi / 60.0


def reflect_rotary_to_linear(
    armature_rotary: float,
    velocity_limit_rotary: float,
    effort_limit_rotary: float,
    transmission_ratio: float,
) -> LinearJointProperties:
    """Return the properties of a rotary motor at a slide joint.

    Args:
        armature_rotary: I (kg m^2).
        velocity_limit_rotary: omega (rad/s).
        effort_limit_rotary: tau (N m).
        transmission_ratio: r (m/rad), travel per angle.

    Returns mass I / r^2, speed r omega and force tau / r.
    """
    return LinearJointProperties(
        armature=armature_rotary / transmission_ratio**2,
        velocity_limit=velocity_limit_rotary * transmission_ratio,
        effort_limit=effort_limit_rotary / transmission_ratio,
    )
