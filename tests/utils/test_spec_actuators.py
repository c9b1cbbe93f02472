"""Actuators added to a spec, checked by the forces they make."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from mjlab.utils.mujoco import detect_command_field
from mjlab.utils.spec import (
    TransmissionType,
    apply_target_overrides,
    create_motor_actuator,
    create_muscle_actuator,
    create_position_actuator,
    create_velocity_actuator,
)

XML = """
<mujoco>
  <compiler angle="{angle}"/>
  <worldbody>
    <body>
      <joint name="hinge" range="{range}"/><geom size="0.1" pos="0.3 0 0"/>
      <body pos="0.1 0 0">
        <joint name="slide" type="slide" range="-0.5 0.5" damping="1"/><geom size="0.1"/>
        <site name="site"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="tendon" range="-2 2"><joint joint="slide" coef="2"/></fixed></tendon>
</mujoco>
"""


@pytest.fixture
def spec():
    return mujoco.MjSpec.from_string(XML.format(angle="degree", range="-90 90"))


def _force(spec: mujoco.MjSpec, ctrl: float, qpos=(0.0, 0.0), qvel=(0.0, 0.0)) -> float:
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = ctrl
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    return float(data.actuator_force[0])


@pytest.mark.parametrize(
    ("target", "kind", "length"),
    [("slide", "joint", 0.1), ("tendon", TransmissionType.TENDON, 0.2)],
)
def test_a_position_servo_follows_its_law(spec, target, kind, length):
    actuator = create_position_actuator(
        spec, target, stiffness=10.0, damping=3.0, effort_limit=4.0, transmission_type=kind
    )
    assert detect_command_field(actuator) == "position"
    ratio = length / 0.1
    assert _force(spec, 0.3, qpos=(0, 0.1)) == pytest.approx(10 * (0.3 - length))
    assert _force(spec, 0.0, qvel=(0, 0.5)) == pytest.approx(-3 * 0.5 * ratio)
    assert _force(spec, 9.0) == 4.0
    assert _force(spec, -9.0) == -4.0


def test_without_an_effort_limit_there_is_none(spec):
    create_position_actuator(spec, "slide", stiffness=10.0, damping=0.0)
    assert _force(spec, 1e3) == pytest.approx(1e4)
    model = spec.compile()
    assert not model.actuator_forcelimited[0]
    assert not model.actuator_ctrllimited[0]


def test_defaults_of_the_main_class_do_not_bring_limits_back():
    xml = XML.format(angle="radian", range="-1 1").replace(
        "<worldbody>",
        '<default><general ctrlrange="-1 1" forcerange="-1 1" dyntype="filter" biastype="affine"/>'
        "</default><worldbody>",
    )
    for create in (
        lambda spec: create_position_actuator(spec, "slide", stiffness=100.0, damping=0.0),
        lambda spec: create_velocity_actuator(spec, "slide", damping=100.0),
        lambda spec: create_motor_actuator(spec, "slide", effort_limit=1e6),
    ):
        spec = mujoco.MjSpec.from_string(xml)
        create(spec)
        assert abs(_force(spec, 5.0)) >= 5.0


@pytest.mark.parametrize(
    ("angle", "limits"), [("degree", "-90 90"), ("radian", f"{-math.pi / 2} {math.pi / 2}")]
)
def test_the_informational_range_is_in_radians_whatever_the_xml_uses(angle, limits):
    spec = mujoco.MjSpec.from_string(XML.format(angle=angle, range=limits))
    create_position_actuator(spec, "hinge", stiffness=10.0, damping=0.0, effort_limit=5.0)
    reach = math.pi / 2 + 0.5
    np.testing.assert_allclose(spec.compile().actuator_ctrlrange[0], (-reach, reach), atol=1e-6)


@pytest.mark.parametrize(
    ("target", "kind", "half"), [("slide", "joint", 0.5), ("tendon",) * 2 + (2,)]
)
def test_lengths_are_not_taken_for_degrees(spec, target, kind, half):
    create_position_actuator(
        spec, target, stiffness=10.0, damping=0.0, effort_limit=5.0, transmission_type=kind
    )
    np.testing.assert_allclose(spec.actuators[0].ctrlrange, (-half - 0.5, half + 0.5))


def test_a_servo_without_stiffness_can_have_an_effort_limit(spec):
    create_position_actuator(spec, "slide", stiffness=0.0, damping=2.0, effort_limit=1.0)
    assert np.isfinite(spec.actuators[0].ctrlrange).all()
    assert _force(spec, 7.0, qvel=(0, 0.25)) == pytest.approx(-0.5)


def test_a_velocity_servo_follows_its_law(spec):
    actuator = create_velocity_actuator(spec, "slide", damping=2.0, effort_limit=3.0)
    assert detect_command_field(actuator) == "velocity"
    assert _force(spec, 1.0, qpos=(0, 0.4), qvel=(0, 0.25)) == pytest.approx(2 * 0.75)
    assert _force(spec, 10.0) == 3.0


def test_a_motor_clamps_before_its_gear(spec):
    actuator = create_motor_actuator(spec, "slide", effort_limit=2.0, gear=5.0)
    assert detect_command_field(actuator) == "effort"
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = 100.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[1] == pytest.approx(10.0)


def test_a_motor_can_be_unlimited_and_act_on_a_site(spec):
    create_motor_actuator(spec, "site", effort_limit=math.inf, transmission_type="site")
    assert _force(spec, 1e6) == 1e6


def test_a_muscle_has_its_parameters(spec):
    actuator = create_muscle_actuator(
        spec, "tendon", length_range=(-1.0, 1.0), force=50.0, timeconst=(0.02, 0.03), gear=2.0
    )
    assert detect_command_field(actuator) == "effort"
    model = spec.compile()
    curve = [0.75, 1.05, 50.0, 200.0, 0.5, 1.6, 1.5, 1.3, 1.2]
    np.testing.assert_allclose(model.actuator_gainprm[0, :9], curve)
    np.testing.assert_allclose(model.actuator_biasprm[0, :9], curve)
    np.testing.assert_allclose(model.actuator_dynprm[0, :3], (0.02, 0.03, 0.0))
    np.testing.assert_allclose(model.actuator_lengthrange[0], (-1, 1))
    np.testing.assert_allclose(model.actuator_ctrlrange[0], (0, 1))
    assert model.actuator_ctrllimited[0]
    assert model.actuator_gear[0, 0] == 2.0


@pytest.mark.parametrize("target", ["slide", "tendon"])
def test_overrides_are_written_where_given(spec, target):
    kind = "tendon" if target == "tendon" else "joint"
    element = getattr(spec, kind)(target)
    before = float(element.damping[0])
    apply_target_overrides(spec, target, kind, armature=0.5, frictionloss=0.2, viscous_damping=None)
    assert (element.armature, element.frictionloss, element.damping[0]) == (0.5, 0.2, before)
    apply_target_overrides(
        spec, target, kind, armature=None, frictionloss=None, viscous_damping=4.0
    )
    assert (element.armature, element.frictionloss, element.damping[0]) == (0.5, 0.2, 4.0)


def test_builders_write_overrides_too(spec):
    create_velocity_actuator(spec, "slide", damping=1.0, armature=0.3, viscous_damping=0.0)
    assert (spec.joint("slide").armature, spec.joint("slide").damping[0]) == (0.3, 0.0)


def test_names_are_those_of_the_targets_unless_given(spec):
    assert create_motor_actuator(spec, "slide", effort_limit=1.0).name == "slide"
    servo = create_position_actuator(
        spec, "slide", stiffness=1.0, damping=0.0, actuator_name="slide_pos"
    )
    assert (servo.name, servo.target) == ("slide_pos", "slide")


def test_an_unknown_target_is_refused_with_the_choices(spec):
    with pytest.raises(ValueError, match=r"joint 'knee'.*\['hinge', 'slide'\]"):
        create_motor_actuator(spec, "knee", effort_limit=1.0)
    assert spec.actuators == []


def test_an_unknown_transmission_is_refused(spec):
    with pytest.raises(ValueError, match=r"\['joint', 'tendon', 'site'\].*'body'"):
        create_motor_actuator(spec, "slide", effort_limit=1.0, transmission_type="body")


def test_actuators_on_sites(spec):
    site = TransmissionType.SITE
    servo = create_position_actuator(
        spec, "site", stiffness=2.0, damping=0.0, effort_limit=3.0, transmission_type=site,
        actuator_name="servo",
    )  # fmt: skip
    assert servo.ctrlrange.tolist() == [-1.5, 1.5]
    create_velocity_actuator(
        spec, "site", damping=1.0, transmission_type=site, actuator_name="speed"
    )
    with pytest.raises(ValueError, match="Site 'site'.*muscles"):
        create_muscle_actuator(spec, "site", transmission_type=site)
    with pytest.warns(UserWarning, match=r"Site 'site'.*armature 0.5"):
        create_motor_actuator(spec, "site", effort_limit=1.0, armature=0.5, transmission_type=site)
    model = spec.compile()
    assert set(model.actuator_trntype.tolist()) == {int(mujoco.mjtTrn.mjTRN_SITE)}
