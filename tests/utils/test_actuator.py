"""Arithmetic of motors and gears, against energy and MuJoCo."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.utils.actuator import (
    ElectricActuator,
    reflect_rotary_to_linear,
    reflected_inertia,
    reflected_inertia_from_two_stage_planetary,
    rpm_to_rad,
)

positive = st.floats(0.01, 100)


@settings(deadline=None)
@given(positive, positive, positive)
def test_a_rotor_has_the_same_energy_on_both_sides_of_its_gear(inertia, ratio, speed):
    at_joint = 0.5 * reflected_inertia(inertia, ratio) * speed**2
    assert at_joint == pytest.approx(0.5 * inertia * (ratio * speed) ** 2)


@settings(deadline=None)
@given(positive, positive, positive, positive, positive, positive)
def test_two_stages_add_the_energies_of_their_parts(j0, j1, j2, g1, g2, speed):
    total = 0.5 * reflected_inertia_from_two_stage_planetary((j0, j1, j2), (1, g1, g2)) * speed**2
    parts = [(j0, g1 * g2 * speed), (j1, g2 * speed), (j2, speed)]
    assert total == pytest.approx(sum(0.5 * j * w**2 for j, w in parts))


def test_the_first_ratio_is_that_of_the_rotor():
    with pytest.raises(ValueError, match=r"gear_ratio\[0\]: expected 1.*got 2"):
        reflected_inertia_from_two_stage_planetary((1, 1, 1), (2, 3, 4))


@settings(deadline=None)
@given(positive, positive, positive, positive)
def test_a_rack_keeps_power_and_energy(inertia, speed, torque, radius):
    linear = reflect_rotary_to_linear(inertia, speed, torque, radius)
    assert linear.velocity_limit == pytest.approx(radius * speed)
    assert linear.effort_limit * linear.velocity_limit == pytest.approx(torque * speed)
    energy = 0.5 * linear.armature * linear.velocity_limit**2
    assert energy == pytest.approx(0.5 * inertia * speed**2)
    assert tuple(linear) == (linear.armature, linear.velocity_limit, linear.effort_limit)


def test_units_and_fields():
    assert rpm_to_rad(60) == pytest.approx(2 * math.pi)
    motor = ElectricActuator(reflected_inertia=0.1, velocity_limit=30.0, effort_limit=20.0)
    assert (motor.reflected_inertia, motor.velocity_limit, motor.effort_limit) == (0.1, 30.0, 20.0)
