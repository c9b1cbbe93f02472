"""Kinds of actuators and widths of joints."""

from __future__ import annotations

import mujoco
import pytest

from mjlab.utils.mujoco import (
    detect_command_field,
    dof_width,
    is_motor_actuator,
    is_muscle_actuator,
    is_position_actuator,
    is_velocity_actuator,
    qpos_width,
)

XML = """
<mujoco>
  <worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
  <actuator>{}</actuator>
</mujoco>
"""
GENERAL = '<general joint="j" gainprm="{}" biastype="affine" biasprm="{}" dyntype="{}"/>'


def _actuator(element: str) -> mujoco.MjsActuator:
    return mujoco.MjSpec.from_string(XML.format(element)).actuators[0]


@pytest.mark.parametrize(
    ("element", "field", "kind"),
    [
        ('<motor joint="j"/>', "effort", is_motor_actuator),
        ('<general joint="j" dyntype="filter"/>', "effort", is_motor_actuator),
        ('<position joint="j" kp="5"/>', "position", is_position_actuator),
        ('<position joint="j" kp="5" kv="2"/>', "position", is_position_actuator),
        ('<position joint="j" kp="5" timeconst="0.1"/>', "position", is_position_actuator),
        ('<velocity joint="j" kv="3"/>', "velocity", is_velocity_actuator),
        (
            '<muscle joint="j" lengthrange="0.1 1"/>',
            "effort",
            is_muscle_actuator,
        ),
    ],
)
def test_each_kind_is_told_from_the_others(element, field, kind):
    actuator = _actuator(element)
    assert detect_command_field(actuator) == field
    kinds = (is_motor_actuator, is_position_actuator, is_velocity_actuator, is_muscle_actuator)
    assert [check for check in kinds if check(actuator)] == [kind]


@pytest.mark.parametrize(
    "element",
    [
        GENERAL.format("5", "0 -4 0", "none"),
        GENERAL.format("5", "1 0 -4", "none"),
        GENERAL.format("5", "0 0 -5", "filterexact"),
    ],
)
def test_an_unknown_kind_is_named(element):
    with pytest.raises(ValueError, match=r"mjBIAS_AFFINE.*command_field"):
        detect_command_field(_actuator(element))


@pytest.mark.parametrize(
    ("kind", "widths"), [("free", (7, 6)), ("ball", (4, 3)), ("slide", (1, 1)), ("hinge", (1, 1))]
)
def test_widths_are_those_of_a_compiled_model(kind, widths):
    joint_type = getattr(mujoco.mjtJoint, f"mjJNT_{kind.upper()}")
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_geom(size=[0.1, 0.1, 0.1])
    body.add_joint(type=joint_type)
    model = spec.compile()
    assert (model.nq, model.nv) == widths
    assert (qpos_width(joint_type), dof_width(int(joint_type))) == widths


def test_an_unknown_joint_type_is_refused():
    with pytest.raises(ValueError, match="joint type 9"):
        qpos_width(9)
