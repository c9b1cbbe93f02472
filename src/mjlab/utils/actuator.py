"""Arithmetic of electric motors and their gears, in SI units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from mjlab.utils.errors import check_positive


@dataclass
class ElectricActuator:
    """A motor as seen at the joint, after its gear."""

    reflected_inertia: float
    """Inertia of the rotor at the joint, kg m^2."""
    velocity_limit: float
    """Largest speed, rad/s."""
    effort_limit: float
    """Largest torque, N m."""


class LinearJointProperties(NamedTuple):
    """A rotary motor as seen at a sliding joint."""

    armature: float
    """Mass, kg."""
    velocity_limit: float
    """Largest speed, m/s."""
    effort_limit: float
    """Largest force, N."""


def reflected_inertia(rotor_inertia: float, gear_ratio: float) -> float:
    """Return the rotor's inertia behind a gear: J G^2."""
    return rotor_inertia * gear_ratio**2


def reflected_inertia_from_two_stage_planetary(
    rotor_inertia: tuple[float, float, float], gear_ratio: tuple[float, float, float]
) -> float:
    """Return the inertia of a motor with two planetary stages: J0 (G1 G2)^2 + J1 G2^2 + J2.

    Args:
        rotor_inertia: (J0, J1, J2), of rotor, first and second stage, kg m^2.
        gear_ratio: (1, G1, G2).

    Raises `ValueError` unless the first ratio is 1.
    """
    if gear_ratio[0] != 1:
        raise ValueError(
            f"The first gear ratio is {gear_ratio[0]}; it must be 1, that of the rotor itself."
        )
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
    """Return what a rotary motor is at a sliding joint.

    Args:
        armature_rotary: I, kg m^2.
        velocity_limit_rotary: omega, rad/s.
        effort_limit_rotary: tau, N m.
        transmission_ratio: r, metres of travel per radian.

    Returns mass I / r^2, speed r omega and force tau / r. Raises `ValueError` unless r > 0.
    """
    check_positive("transmission_ratio (m/rad)", transmission_ratio)
    return LinearJointProperties(
        armature=armature_rotary / transmission_ratio**2,
        velocity_limit=velocity_limit_rotary * transmission_ratio,
        effort_limit=effort_limit_rotary / transmission_ratio,
    )
