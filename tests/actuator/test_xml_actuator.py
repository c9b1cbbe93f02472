"""Actuators taken over from the XML."""

from __future__ import annotations

import warnings

import pytest
import torch

from mjlab.actuator import TransmissionType, XmlActuatorCfg

JOINTS = ("hip", "knee", "ankle")
MOTORS = '<actuator><motor joint="knee"/><motor name="second" joint="knee"/><motor joint="hip"/></actuator>'


@pytest.mark.parametrize(
    ("element", "field"),
    [
        ('<motor joint="hip"/>', "effort"),
        ('<position joint="hip" kp="7" kv="1"/>', "position"),
        ('<position joint="hip" kp="7" timeconst="0.1"/>', "position"),
        ('<velocity joint="hip" kv="3"/>', "velocity"),
        ('<muscle joint="hip" lengthrange="0.1 1" force="10"/>', "effort"),
    ],
)
def test_kind_is_detected_and_its_command_becomes_the_control(make_world, element, field):
    world = make_world(
        XmlActuatorCfg(target_names_expr=("hip",)), extra=f"<actuator>{element}</actuator>"
    )
    world.entity.set_joint_position_target(torch.full((3, 3), 1.0))
    world.entity.set_joint_velocity_target(torch.full((3, 3), 2.0))
    world.entity.set_joint_effort_target(torch.full((3, 3), 3.0))
    world.entity.write_data_to_sim()
    assert world.entity.actuators[0].command_field == field
    assert (
        world.ctrl[:, 0].tolist() == [{"position": 1.0, "velocity": 2.0, "effort": 3.0}[field]] * 3
    )


def test_first_actuators_of_targets_are_taken(make_world):
    world = make_world(XmlActuatorCfg(target_names_expr=JOINTS), extra=MOTORS)
    actuator = world.entity.actuators[0]
    assert actuator.target_names == ["hip", "knee"]
    assert actuator.target_ids.tolist() == [0, 1]
    assert actuator.ctrl_ids.tolist() == [2, 0]
    world.entity.set_joint_effort_target(torch.tensor([[1.0, 2.0, 3.0]] * 3))
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[2.0, 0.0, 1.0]] * 3


def test_a_tendon_of_the_same_name_does_not_lend_its_actuator_to_a_joint(make_world):
    extra = """<tendon><fixed name="hip"><joint joint="knee" coef="1"/></fixed></tendon>
    <actuator><motor tendon="hip"/><velocity joint="hip" kv="2"/></actuator>"""
    with pytest.warns(UserWarning, match="also match the tendons"):
        world = make_world(XmlActuatorCfg(target_names_expr=("hip",)), extra=extra)
    assert world.entity.actuators[0].command_field == "velocity"
    assert world.entity.actuators[0].ctrl_ids.tolist() == [1]


def test_no_actuator_on_any_target_lists_what_the_xml_has(make_world):
    with pytest.raises(ValueError, match=r"joints \['ankle'\].*'second on joint 'knee'|second on"):
        make_world(XmlActuatorCfg(target_names_expr=("ankle",)), extra=MOTORS)


def test_several_kinds_in_one_config_are_refused_with_the_breakdown(make_world):
    extra = '<actuator><motor joint="hip"/><position name="servo" joint="knee" kp="1"/></actuator>'
    with pytest.raises(ValueError, match=r"effort: \['hip'\]; position: \['servo'\]"):
        make_world(XmlActuatorCfg(target_names_expr=("hip", "knee")), extra=extra)


def test_stated_command_field_must_agree_with_the_xml(make_world):
    with pytest.raises(ValueError, match=r"command_field='position'.*effort: \['hip'\]"):
        make_world(
            XmlActuatorCfg(target_names_expr=("hip",), command_field="position"),
            extra='<actuator><motor joint="hip"/></actuator>',
        )


def test_stated_command_field_is_trusted_for_a_kind_that_is_not_detected(make_world):
    extra = '<actuator><damper joint="hip" kv="1" ctrlrange="0 1"/></actuator>'
    with pytest.raises(ValueError, match="unknown kind"):
        make_world(XmlActuatorCfg(target_names_expr=("hip",)), extra=extra)
    world = make_world(
        XmlActuatorCfg(target_names_expr=("hip",), command_field="effort"), extra=extra
    )
    assert world.entity.actuators[0].command_field == "effort"


def test_unknown_command_field_is_refused():
    with pytest.raises(ValueError, match="command_field: .*'effort'.*'torque'"):
        XmlActuatorCfg(target_names_expr=("hip",), command_field="torque")  # type: ignore[arg-type]


def test_servo_on_a_site_warns_that_its_control_stays_zero(make_world):
    extra = '<actuator><position site="toe" refsite="toe" kp="2" gear="1 0 0 0 0 0"/></actuator>'
    cfg = XmlActuatorCfg(target_names_expr=("toe",), transmission_type=TransmissionType.SITE)
    with pytest.warns(UserWarning, match="their control stays 0"):
        world = make_world(cfg, extra=extra)
    world.ctrl[:] = 5.0
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[0.0]] * 3


def test_older_names_stand_for_the_one_that_detects_the_kind():
    from mjlab import actuator

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        for kind in ("Motor", "Position", "Velocity", "Muscle"):
            assert getattr(actuator, f"Xml{kind}ActuatorCfg") is XmlActuatorCfg
            assert getattr(actuator.xml_actuator, f"Xml{kind}ActuatorCfg") is XmlActuatorCfg
