"""Forces of the actuators that MuJoCo simulates, against their formulas."""

from __future__ import annotations

import math

import pytest
import torch

from mjlab.actuator import (
    ActuatorCfg,
    BuiltinDcMotorActuatorCfg,
    BuiltinMotorActuatorCfg,
    BuiltinMuscleActuatorCfg,
    BuiltinPdActuator,
    BuiltinPdActuatorCfg,
    BuiltinPositionActuatorCfg,
    BuiltinVelocityActuatorCfg,
    DcMotorDatasheetParams,
    DcMotorInputMode,
    DcMotorPhysicalParams,
    TransmissionType,
    XmlActuatorCfg,
)

JOINTS = ("hip", "knee", "ankle")
POS = torch.tensor([[0.1, -0.2, 0.3], [0.4, 0.5, -0.6], [0.0, 0.0, 0.0]])
VEL = torch.tensor([[1.0, 2.0, -1.0], [0.0, -2.0, 3.0], [0.5, 0.5, 0.5]])
TARGET = torch.tensor([[0.5, -0.5, 1.0], [-1.0, 1.0, 0.2], [9.0, -9.0, 9.0]])
MOTOR = DcMotorDatasheetParams(nominal_voltage=24.0, stall_torque=5.0, no_load_speed=30.0)


def test_position_servo_force_is_clamped_pd_of_the_position_target(make_world):
    world = make_world(
        BuiltinPositionActuatorCfg(
            target_names_expr=JOINTS, stiffness=20.0, damping=2.0, effort_limit=15.0
        )
    )
    world.set_state(POS, VEL)
    world.entity.set_joint_position_target(TARGET)
    expected = (20.0 * (TARGET - POS) - 2.0 * VEL).clamp(-15.0, 15.0)
    torch.testing.assert_close(world.force(), expected)


def test_velocity_servo_force_is_clamped_gain_times_velocity_error(make_world):
    world = make_world(
        BuiltinVelocityActuatorCfg(target_names_expr=JOINTS, damping=3.0, effort_limit=10.0)
    )
    world.set_state(POS, VEL)
    world.entity.set_joint_velocity_target(TARGET)
    torch.testing.assert_close(world.force(), (3.0 * (TARGET - VEL)).clamp(-10.0, 10.0))


def test_motor_applies_gear_times_the_clamped_effort_target(make_world):
    world = make_world(
        BuiltinMotorActuatorCfg(target_names_expr=JOINTS, effort_limit=2.0, gear=7.0)
    )
    world.entity.set_joint_effort_target(TARGET)
    world.force()
    torch.testing.assert_close(world.sim.data.qfrc_actuator, 7.0 * TARGET.clamp(-2.0, 2.0))


def test_infinite_effort_limit_of_a_motor_is_no_limit(make_world):
    world = make_world(BuiltinMotorActuatorCfg(target_names_expr=JOINTS, effort_limit=math.inf))
    world.entity.set_joint_effort_target(1000.0 * TARGET)
    torch.testing.assert_close(world.force(), 1000.0 * TARGET)


def test_motor_on_a_tendon_pulls_its_joints_by_their_coefficients(make_world):
    world = make_world(
        BuiltinMotorActuatorCfg(
            target_names_expr=("cord",), transmission_type=TransmissionType.TENDON, effort_limit=9.0
        )
    )
    world.entity.set_tendon_effort_target(torch.full((3, 1), 4.0))
    world.force()
    expected = torch.tensor([4.0, -2.0, 0.0]).expand(3, 3)
    torch.testing.assert_close(world.sim.data.qfrc_actuator, expected)


def test_motor_on_a_site_acts_along_its_x_axis(make_world):
    world = make_world(
        BuiltinMotorActuatorCfg(
            target_names_expr=("toe",), transmission_type=TransmissionType.SITE, effort_limit=9.0
        )
    )
    # The foot is turned by a quarter about y, so that the site's x axis points down (-z), and the
    # lever arms of hip and knee are their distances along x, 0.8 and 0.4.
    world.set_state(torch.tensor([[0.0, 0.0, math.pi / 2]] * 3), torch.zeros(3, 3))
    world.entity.set_site_effort_target(torch.full((3, 1), 2.0))
    world.force()
    expected = torch.tensor([1.6, 0.8, 0.0]).expand(3, 3)
    torch.testing.assert_close(world.sim.data.qfrc_actuator, expected, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("sort", [False, True])
def test_native_pd_sends_each_element_its_own_target_in_any_element_order(make_world, sort):
    """Sorted, elements come interleaved, while the controls are all positions, then velocities."""
    world = make_world(
        BuiltinPdActuatorCfg(target_names_expr=JOINTS, stiffness=20.0, damping=3.0), sort=sort
    )
    world.set_state(POS, VEL)
    world.entity.set_joint_position_target(TARGET)
    world.entity.set_joint_velocity_target(2.0 * TARGET)
    world.force()
    expected = 20.0 * (TARGET - POS) + 3.0 * (2.0 * TARGET - VEL)
    torch.testing.assert_close(world.sim.data.qfrc_actuator, expected)
    actuator = world.entity.actuators[0]
    assert isinstance(actuator, BuiltinPdActuator)
    names = [world.entity.actuator_names[i] for i in actuator.ctrl_ids.tolist()]
    assert names == [f"{j}_pd_{k}" for k in ("pos", "vel") for j in ("hip", "knee", "ankle")]
    assert actuator.num_targets == 3


def test_native_pd_effort_limit_clamps_the_sum_at_the_joint(make_world):
    world = make_world(
        BuiltinPdActuatorCfg(
            target_names_expr=JOINTS, stiffness=20.0, damping=3.0, effort_limit=6.0
        )
    )
    world.set_state(POS, VEL)
    world.entity.set_joint_position_target(TARGET)
    world.force()
    expected = (20.0 * (TARGET - POS) - 3.0 * VEL).clamp(-6.0, 6.0)
    torch.testing.assert_close(world.sim.data.qfrc_actuator, expected)


def test_native_pd_on_a_tendon_is_clamped_there(make_world):
    world = make_world(
        BuiltinPdActuatorCfg(
            target_names_expr=("cord",),
            transmission_type=TransmissionType.TENDON,
            stiffness=20.0,
            damping=3.0,
            effort_limit=6.0,
        )
    )
    world.set_state(POS, VEL)
    world.entity.set_tendon_len_target(torch.full((3, 1), 0.2))
    world.force()
    length, speed = POS[:, 0] - 0.5 * POS[:, 1], VEL[:, 0] - 0.5 * VEL[:, 1]
    expected = (20.0 * (0.2 - length) - 3.0 * speed).clamp(-6.0, 6.0)
    torch.testing.assert_close(world.sim.data.qfrc_actuator[:, 0], expected)


def test_dc_motor_in_voltage_mode_gives_the_torque_of_its_data_sheet(make_world):
    world = make_world(
        BuiltinDcMotorActuatorCfg(
            target_names_expr=JOINTS, motor_params=MOTOR, mode=DcMotorInputMode.VOLTAGE
        )
    )
    world.set_state(POS, VEL)
    volts = torch.tensor([24.0, -12.0, 0.0]).expand(3, 3)
    world.entity.set_joint_effort_target(volts)
    # K = V / w = 0.8, R = K V / T = 3.84.
    torch.testing.assert_close(world.force(), 0.8 * (volts - 0.8 * VEL) / 3.84)


def test_dc_motor_by_physical_constants_is_the_same_motor(make_world):
    params = DcMotorPhysicalParams(kt=0.8, ke=0.8, resistance=3.84)
    forces = []
    for motor in (MOTOR, params):
        world = make_world(
            BuiltinDcMotorActuatorCfg(
                target_names_expr=JOINTS, motor_params=motor, mode=DcMotorInputMode.VOLTAGE
            )
        )
        world.set_state(POS, VEL)
        world.entity.set_joint_effort_target(TARGET)
        forces.append(world.force())
    torch.testing.assert_close(*forces)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"mode": DcMotorInputMode.VOLTAGE, "stiffness": 1.0}, "stiffness: .*VOLTAGE.*1.0"),
        ({"mode": DcMotorInputMode.POSITION, "voltage_limit": 24.0}, "stiffness in mode POSITION.*0.0"),
        ({"mode": DcMotorInputMode.VELOCITY, "stiffness": 1.0}, "voltage_limit in mode VELOCITY.*0.0"),
        ({"mode": 7, "stiffness": 1.0}, "mode: .*VELOCITY.*7"),
        ({"stiffness": 1.0, "voltage_limit": 24.0, "cogging": (1.0,)}, r"cogging: expected 3.*\(1.0,\)"),
    ],
)  # fmt: skip
def test_dc_motor_refuses_figures_that_its_mode_does_not_have(fields, named):
    with pytest.raises(ValueError, match=named):
        BuiltinDcMotorActuatorCfg(target_names_expr=("hip",), motor_params=MOTOR, **fields)


@pytest.mark.parametrize("limit", [0.0, -1.0])
def test_dc_motor_without_effort_limit(make_world, limit):
    cfg = {"motor_params": MOTOR, "stiffness": 1.0, "voltage_limit": 24.0}
    limits = [
        make_world(
            BuiltinDcMotorActuatorCfg(target_names_expr=("hip",), effort_limit=one, **cfg)
        ).sim.mj_model.actuator_forcerange.tolist()
        for one in (None, limit)
    ]
    assert limits[0] == limits[1]


def test_integral_gain_without_effect_warns_once(make_world):
    cfg = BuiltinDcMotorActuatorCfg(
        target_names_expr=("hip",), motor_params=MOTOR, mode=DcMotorInputMode.VELOCITY,
        stiffness=1.0, voltage_limit=24.0, integral_gain=2.0,
    )  # fmt: skip
    with pytest.warns(UserWarning, match="integral_gain: .*2.0.*POSITION") as caught:
        make_world(cfg)
    assert len(caught) == 1


def test_dc_motor_that_mujoco_refuses_names_the_config(make_world):
    params = DcMotorPhysicalParams(kt=0.0, ke=0.0, resistance=0.0)
    with pytest.raises(ValueError, match="BuiltinDcMotorActuatorCfg for .*'hip'"):
        make_world(
            BuiltinDcMotorActuatorCfg(
                target_names_expr=("hip",), motor_params=params, mode=DcMotorInputMode.VOLTAGE
            )
        )


def test_muscle_reads_the_effort_target_as_excitation(make_world):
    world = make_world(
        BuiltinMuscleActuatorCfg(
            target_names_expr=("cord",),
            transmission_type=TransmissionType.TENDON,
            length_range=(-1.5, 1.5),
            force=50.0,
            timeconst=(0.005, 0.02),
        )
    )
    world.entity.set_tendon_effort_target(torch.tensor([[0.0], [0.5], [1.0]]))
    world.entity.write_data_to_sim()
    assert world.ctrl.tolist() == [[0.0], [0.5], [1.0]]
    for _ in range(5):
        world.sim.step()
    activation = world.sim.data.act[:, 0]
    assert activation[0] == 0.0 < activation[1] < activation[2]
    assert world.sim.data.actuator_force[2, 0] < -1.0  # Muscles pull.


MUSCLE = BuiltinMuscleActuatorCfg(
    target_names_expr=("hip",), length_range=(0.1, 1.0), force=10.0,
    armature=0.5, frictionloss=0.25, viscous_damping=0.125,
)  # fmt: skip
XML = XmlActuatorCfg(
    target_names_expr=("hip",), armature=0.5, frictionloss=0.25, viscous_damping=0.125
)
DC = BuiltinDcMotorActuatorCfg(
    target_names_expr=("hip",), motor_params=MOTOR, mode=DcMotorInputMode.VOLTAGE,
    armature=0.5, frictionloss=0.25, viscous_damping=0.125,
)  # fmt: skip
NATIVE_PD = BuiltinPdActuatorCfg(
    target_names_expr=("hip",), stiffness=1.0, damping=1.0,
    armature=0.5, frictionloss=0.25, viscous_damping=0.125,
)  # fmt: skip


@pytest.mark.parametrize("cfg", [MUSCLE, XML, DC, NATIVE_PD], ids=lambda cfg: type(cfg).__name__)
def test_armature_friction_and_damping_reach_the_joint_for_every_kind(make_world, cfg: ActuatorCfg):
    extra = '<actuator><motor joint="hip"/></actuator>' if isinstance(cfg, XmlActuatorCfg) else ""
    model = make_world(cfg, extra=extra).sim.mj_model
    assert model.dof_armature.tolist() == [0.5, 0.0, 0.0]
    assert model.dof_frictionloss.tolist() == [0.25, 0.0, 0.0]
    assert model.dof_damping.tolist() == [0.125, 0.0, 0.0]


def test_effort_limit_without_stiffness_builds(make_world):
    world = make_world(
        BuiltinPositionActuatorCfg(
            target_names_expr=("hip",), stiffness=0.0, damping=2.0, effort_limit=5.0
        )
    )
    world.set_state(POS, VEL)
    torch.testing.assert_close(world.force(), -2.0 * VEL[:, :1])


def test_informational_control_range_follows_a_range_authored_in_degrees(make_world):
    xml = """<mujoco><worldbody><body><joint name="hip" range="-90 45"/><geom size="0.1"/></body>
    </worldbody></mujoco>"""
    world = make_world(
        BuiltinPositionActuatorCfg(
            target_names_expr=("hip",), stiffness=5.0, damping=1.0, effort_limit=10.0
        ),
        xml=xml,
    )
    expected = [-math.pi / 2 - 2.0, math.pi / 4 + 2.0]
    assert world.sim.mj_model.actuator_ctrlrange[0].tolist() == pytest.approx(expected)
