"""Gains and effort limits, by kind of actuator."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.actuator import (
    BuiltinDcMotorActuatorCfg,
    BuiltinMotorActuatorCfg,
    BuiltinMuscleActuatorCfg,
    BuiltinPdActuatorCfg,
    BuiltinPositionActuatorCfg,
    BuiltinVelocityActuatorCfg,
    DcMotorActuatorCfg,
    DcMotorDatasheetParams,
    DcMotorInputMode,
    IdealPdActuatorCfg,
    XmlActuatorCfg,
)
from mjlab.envs.mdp import dr
from mjlab.managers.scene_entity_config import SceneEntityCfg

POSITION = BuiltinPositionActuatorCfg(
    target_names_expr=("hip",), stiffness=20.0, damping=2.0, effort_limit=5.0
)
IDEAL = IdealPdActuatorCfg(
    target_names_expr=("knee", "ankle"), stiffness=10.0, damping=1.0, effort_limit=4.0
)


def names(*actuator_names: str) -> SceneEntityCfg:
    return SceneEntityCfg("robot", actuator_names=list(actuator_names))


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_servo_gains_scale_the_defaults_and_keep_their_signs(make_world: Any, engine: str) -> None:
    world = make_world(actuators=(POSITION, IDEAL), engine=engine)
    for _ in range(3):
        world.apply(
            dr.pd_gains,
            torch.tensor([1]),
            kp_range=(2.0, 2.0),
            kd_range=(3.0, 3.0),
            asset_cfg=names("hip"),
        )
    model = world.sim.model
    assert model.actuator_gainprm[:, 0, 0].tolist() == [20.0, 40.0, 20.0, 20.0]
    assert model.actuator_biasprm[:, 0, 1].tolist() == [-20.0, -40.0, -20.0, -20.0]
    assert model.actuator_biasprm[:, 0, 2].tolist() == [-2.0, -6.0, -2.0, -2.0]


def test_the_first_two_of_three_numbers_are_the_range(make_world: Any) -> None:
    world = make_world(actuators=(POSITION,))
    with pytest.warns(UserWarning, match=r"kp_range: .*first two"):
        world.apply(dr.pd_gains, kp_range=(2.0, 2.0, 9.0), kd_range=(1.0, 1.0))
    assert world.sim.model.actuator_gainprm[:, 0, 0].tolist() == [40.0] * 4
    with pytest.warns(UserWarning, match=r"effort_limit_range: .*first two"):
        world.apply(dr.effort_limits, effort_limit_range=(2.0, 2.0, 9.0))
    assert world.sim.model.actuator_forcerange[0, 0].tolist() == [-10.0, 10.0]


def test_single_actuators_are_selected_across_groups(make_world: Any) -> None:
    # "ankle" is the third actuator, and the second target of the second group.
    world = make_world(actuators=(POSITION, IDEAL))
    world.apply(
        dr.pd_gains,
        kp_range=(7.0, 7.0),
        kd_range=(0.5, 0.5),
        asset_cfg=names("ankle"),
        operation="abs",
    )
    ideal = world.robot.actuators[1]
    assert ideal.stiffness[0].tolist() == [10.0, 7.0]
    assert ideal.damping[0].tolist() == [1.0, 0.5]
    assert world.sim.model.actuator_gainprm[0, 0, 0] == 20.0


def test_draws_are_independent_for_each_environment_and_actuator(make_world: Any) -> None:
    world = make_world(actuators=(POSITION, IDEAL))
    world.apply(dr.pd_gains, kp_range=(0.5, 2.0), kd_range=(0.5, 2.0), distribution="log_uniform")
    ideal = world.robot.actuators[1]
    factors = torch.cat((ideal.stiffness / 10.0, ideal.damping), dim=1)
    assert len(factors.unique()) == factors.numel()
    assert bool(((factors >= 0.5) & (factors <= 2.0)).all())


def test_native_pd_writes_both_elements(make_world: Any) -> None:
    cfg = BuiltinPdActuatorCfg(
        target_names_expr=("hip", "knee"), stiffness=8.0, damping=1.5, effort_limit=6.0
    )
    world = make_world(actuators=(cfg,))
    world.apply(
        dr.pd_gains, kp_range=(2.0, 2.0), kd_range=(4.0, 4.0), asset_cfg=names("knee_pd_.*")
    )
    gain, bias = world.sim.model.actuator_gainprm[0], world.sim.model.actuator_biasprm[0]
    assert gain[:, 0].tolist() == [8.0, 16.0, 1.5, 6.0]
    assert bias[:, 1].tolist() == [-8.0, -16.0, 0.0, 0.0]
    assert bias[:, 2].tolist() == [0.0, 0.0, -1.5, -6.0]
    world.apply(dr.effort_limits, effort_limit_range=(0.5, 0.5), asset_cfg=names("knee_pd_.*"))
    ranges = world.sim.model.jnt_actfrcrange[0, 1:3].tolist()
    assert ranges == [[-6.0, 6.0], [-3.0, 3.0]]


@pytest.mark.parametrize("mode", [DcMotorInputMode.POSITION, DcMotorInputMode.VELOCITY])
@pytest.mark.parametrize("operation", ["scale", "abs"])
def test_dc_motor_gains_are_randomized_in_volts(
    make_world: Any, mode: DcMotorInputMode, operation: str
) -> None:
    cfg = BuiltinDcMotorActuatorCfg(
        target_names_expr=("hip",), motor_params=MOTOR_PARAMS, mode=mode,
        stiffness=2.0, damping=0.5, voltage_limit=24.0,
    )  # fmt: skip
    world, reset = make_world(actuators=(cfg,)), torch.tensor([1])
    before = {"kp": 2.0, "kd": 0.5}
    after = {"kp": 3.0, "kd": 0.25} if operation == "abs" else {"kp": 6.0, "kd": 0.125}
    kp, kd = (3.0, 3.0), (0.25, 0.25)
    for _ in range(2):
        world.apply(dr.pd_gains, reset, kp_range=kp, kd_range=kd, operation=operation)
    angle, speed, target = 0.2, 1.5, 0.9
    expected = []
    for gains in (before, after):
        volts = gains["kp"] * (target - angle) - gains["kd"] * speed
        if mode == DcMotorInputMode.VELOCITY:
            volts = gains["kp"] * (target - speed)
        # K = 0.8 and R = 0.384 of the data sheet.
        expected.append(0.8 * (volts - 0.8 * speed) / 0.384)
    torques = hip_torque(world, angle, speed, pos=target, vel=target)
    assert torques == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"mode": DcMotorInputMode.VOLTAGE}, r"\['hip'\].*voltage mode"),
        (
            {
                "mode": DcMotorInputMode.VELOCITY, "stiffness": 2.0, "voltage_limit": 24.0,
                "slew_rate": 5.0,
            },
            r"\['hip'\].*slew_rate",
        ),
    ],
)  # fmt: skip
def test_dc_motors_without_gains_to_randomize_are_refused(
    make_world: Any, fields: dict[str, Any], named: str
) -> None:
    cfg = BuiltinDcMotorActuatorCfg(target_names_expr=("hip",), motor_params=MOTOR_PARAMS, **fields)
    with pytest.raises(ValueError, match=named):
        make_world(actuators=(cfg,)).apply(dr.pd_gains, kp_range=(1.0, 1.0), kd_range=(1.0, 1.0))


def test_effort_limits_scale_both_ends(make_world: Any) -> None:
    world = make_world(actuators=(POSITION,))
    world.apply(dr.effort_limits, torch.tensor([2]), effort_limit_range=(0.5, 0.5))
    ranges = world.sim.model.actuator_forcerange[:, 0]
    assert ranges[2].tolist() == [-2.5, 2.5]
    assert ranges[0].tolist() == [-5.0, 5.0]
    world.apply(dr.effort_limits, effort_limit_range=(9.0, 9.0), operation="abs")
    assert ranges[0].tolist() == [-9.0, 9.0]


def test_a_larger_limit_of_an_ideal_actuator_takes_effect(make_world: Any) -> None:
    world = make_world(actuators=(IDEAL,))
    world.apply(
        dr.effort_limits, torch.tensor([1]), effort_limit_range=(3.0, 3.0), asset_cfg=names("knee")
    )
    ideal = world.robot.actuators[0]
    assert ideal.force_limit[1].tolist() == [12.0, 4.0]
    assert world.sim.model.actuator_forcerange[1, :, 1].tolist() == [12.0, 4.0]
    assert world.sim.model.actuator_ctrlrange[1, :, 0].tolist() == [-12.0, -4.0]
    # The knee wants much more than either limit: MuJoCo's motor lets the larger one through.
    world.robot.set_joint_position_target(torch.full((4, 3), 100.0))
    world.robot.write_data_to_sim()
    world.sim.step()
    assert world.robot.data.actuator_force[:2, 0].tolist() == pytest.approx([4.0, 12.0])


def test_kinds_without_gains_are_refused_by_name(make_world: Any) -> None:
    world = make_world(
        actuators=(BuiltinMotorActuatorCfg(target_names_expr=("hip",), effort_limit=3.0),)
    )
    with pytest.raises(TypeError, match=r"pd_gains: .*\['hip'\].*BuiltinMotorActuator"):
        world.apply(dr.pd_gains, kp_range=(1.0, 1.0), kd_range=(1.0, 1.0))


MOTOR_PARAMS = DcMotorDatasheetParams(nominal_voltage=24.0, stall_torque=50.0, no_load_speed=30.0)
HIP: dict[str, Any] = {"target_names_expr": ("hip",)}
GAINS: dict[str, Any] = {**HIP, "stiffness": 8.0, "damping": 1.5}
KINDS = {
    "position": BuiltinPositionActuatorCfg(**GAINS, effort_limit=5.0),
    "velocity": BuiltinVelocityActuatorCfg(**HIP, damping=1.5, effort_limit=5.0),
    "motor": BuiltinMotorActuatorCfg(**HIP, effort_limit=5.0, gear=2.0),
    "muscle": BuiltinMuscleActuatorCfg(**HIP, force=30.0, length_range=(-1.0, 1.0)),
    "scaled muscle": BuiltinMuscleActuatorCfg(**HIP, length_range=(-1.0, 1.0)),
    "pd": BuiltinPdActuatorCfg(**GAINS, effort_limit=5.0),
    "dc motor": BuiltinDcMotorActuatorCfg(
        **HIP,
        # Times K/R = 0.8 / 0.384 these are the gains of the others.
        stiffness=3.84,
        damping=0.72,
        motor_params=MOTOR_PARAMS,
        voltage_limit=24.0,
        effort_limit=5.0,
    ),
    "voltage": BuiltinDcMotorActuatorCfg(
        **HIP, motor_params=MOTOR_PARAMS, mode=DcMotorInputMode.VOLTAGE, effort_limit=5.0
    ),
    "ideal pd": IdealPdActuatorCfg(**GAINS, effort_limit=5.0),
    "torque-speed curve": DcMotorActuatorCfg(
        **GAINS, effort_limit=5.0, saturation_effort=50.0, velocity_limit=30.0
    ),
}
WITHOUT_GAINS = ("motor", "muscle", "scaled muscle", "voltage")


def hip_torque(world: Any, angle: float, speed: float, **targets: float) -> list[float]:
    """Return the torque on the hip in the first two environments, for a state and targets."""
    data = world.sim.data
    data.qpos[:, 7], data.qvel[:, 6] = angle, speed
    data.act[:] = 1.0
    for name, value in targets.items():
        getattr(world.robot.data, f"joint_{name}_target")[:] = value
    world.robot.write_data_to_sim()
    _ = data.qfrc_actuator
    world.sim.forward()
    return data.qfrc_actuator[:2, 6].tolist()


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("kind", KINDS)
def test_gains_and_effort_limits_of_every_kind_act_on_the_joint(
    make_world: Any, kind: str, engine: str
) -> None:
    world, chosen = make_world(actuators=(KINDS[kind],), engine=engine), torch.tensor([1])
    most, limited = hip_torque(world, 0.0, 0.0, pos=90.0, vel=90.0, effort=90.0)
    assert most == limited
    world.apply(dr.effort_limits, chosen, effort_limit_range=(0.5, 0.5))
    assert hip_torque(world, 0.0, 0.0) == pytest.approx([most, 0.5 * most], rel=1e-4)
    if "muscle" not in kind:
        gear = 2.0 if kind == "motor" else 1.0
        world.apply(dr.effort_limits, chosen, effort_limit_range=(3.0, 3.0), operation="abs")
        torques = hip_torque(world, 0.0, 0.0)
        assert torques == pytest.approx([5.0 * gear, 3.0 * gear], rel=1e-4)
    if kind in WITHOUT_GAINS:
        return
    world.apply(dr.pd_gains, chosen, kp_range=(2.0, 2.0), kd_range=(3.0, 3.0))
    if kind != "velocity":
        torques = hip_torque(world, 0.0, 0.0, pos=0.1, vel=0.0, effort=0.0)
        assert torques == pytest.approx([0.8, 1.6], rel=1e-4)
    torques = hip_torque(world, 0.0, 0.4, pos=0.0, vel=0.0, effort=0.0)
    back_emf = 0.4 * 0.8**2 / 0.384 if kind == "dc motor" else 0.0
    assert torques == pytest.approx([-0.6 - back_emf, -1.8 - back_emf], rel=1e-4)


def test_only_scale_and_abs_are_known(make_world: Any) -> None:
    world = make_world(actuators=(POSITION,))
    with pytest.raises(ValueError, match=r"pd_gains operation: .*\['scale', 'abs'\], got 'add'"):
        world.apply(dr.pd_gains, kp_range=(1.0, 1.0), kd_range=(1.0, 1.0), operation="add")


def custom(name: str, uses_defaults: bool = True, **functions: Any) -> dr.Operation:
    functions = {"initialize": torch.ones_like, "combine": torch.mul} | functions
    return dr.Operation(name, uses_defaults=uses_defaults, **functions)


# Each starts from 20, 2 (position servo) or 10, 1 (ideal), and is applied twice with samples 4.
OPERATIONS = {
    "scale": ("scale", (80.0, 8.0), (40.0, 4.0)),
    "abs": ("abs", (4.0, 4.0), (4.0, 4.0)),
    "as ours": (custom("scale"), (80.0, 8.0), (40.0, 4.0)),
    "divide": (custom("scale", combine=torch.div), (5.0, 0.5), (2.5, 0.25)),
    "add": (
        custom("add", initialize=torch.zeros_like, combine=torch.add),
        (24.0, 6.0),
        (14.0, 5.0),
    ),
    "current": (custom("mine", uses_defaults=False), (320.0, 32.0), (160.0, 16.0)),
    "twice the sample": (
        custom("abs", uses_defaults=False, combine=lambda base, rnd: 2.0 * rnd),
        (8.0, 8.0),
        (8.0, 8.0),
    ),
}


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_decide_about_gains(make_world: Any, name: str, engine: str) -> None:
    operation, servo, ideal = OPERATIONS[name]
    world = make_world(actuators=(POSITION, IDEAL), engine=engine)
    for _ in range(2):
        ranges = {"kp_range": (4.0, 4.0), "kd_range": (4.0, 4.0)}
        world.apply(dr.pd_gains, torch.tensor([1, 2]), operation=operation, **ranges)
    model, second = world.sim.model, world.robot.actuators[1]
    for row, (kp, kd), own in (
        (0, (20.0, 2.0), (10.0, 1.0)),
        (1, servo, ideal),
        (2, servo, ideal),
    ):
        assert model.actuator_gainprm[row, 0, 0] == pytest.approx(kp)
        assert model.actuator_biasprm[row, 0, 1:3].tolist() == pytest.approx([-kp, -kd])
        assert second.stiffness[row].tolist() == pytest.approx([own[0]] * 2)
        assert second.damping[row].tolist() == pytest.approx([own[1]] * 2)


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize(
    ("operation", "limits"),
    [
        (custom("scale"), (10.0, 8.0)),
        (custom("scale", combine=torch.div), (2.5, 2.0)),
        (custom("add", initialize=torch.zeros_like, combine=torch.add), (7.0, 6.0)),
        (custom("mine", uses_defaults=False), (20.0, 16.0)),
    ],
)
def test_operations_decide_about_effort_limits(
    make_world: Any, operation: Any, limits: tuple[float, float], engine: str
) -> None:
    world = make_world(actuators=(POSITION, IDEAL), engine=engine)
    for _ in range(2):
        world.apply(dr.effort_limits, effort_limit_range=(2.0, 2.0), operation=operation)
    servo, ideal = limits
    ranges = world.sim.model.actuator_forcerange[0].tolist()
    assert ranges[0] == pytest.approx([-servo, servo])
    assert ranges[1] == pytest.approx([-ideal, ideal])
    assert world.robot.actuators[1].force_limit[0].tolist() == pytest.approx([ideal, ideal])


@pytest.mark.parametrize("mode", [DcMotorInputMode.POSITION, DcMotorInputMode.VELOCITY])
def test_custom_operations_act_in_volts(make_world: Any, mode: DcMotorInputMode) -> None:
    gains = []
    for operation in ("scale", custom("scale"), custom("mine", combine=lambda b, r: b * r)):
        cfg = BuiltinDcMotorActuatorCfg(
            target_names_expr=("hip",), motor_params=MOTOR_PARAMS, mode=mode,
            stiffness=2.0, damping=0.5, voltage_limit=24.0,
        )  # fmt: skip
        world = make_world(actuators=(cfg,))
        world.apply(dr.pd_gains, kp_range=(3.0, 3.0), kd_range=(2.0, 2.0), operation=operation)
        gains.append(world.sim.model.actuator_gainprm[0, 0])
    assert not torch.equal(gains[0], world.sim.get_default_field("actuator_gainprm")[0])
    torch.testing.assert_close(gains[1], gains[0])
    torch.testing.assert_close(gains[2], gains[0])


# Selections by joint. "hip" is a servo, "knee" and "ankle" are ideal.
@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize(
    ("joints", "factors"),
    [
        (("knee",), (1.0, 3.0, 1.0)),
        (("hip", "ankle"), (3.0, 1.0, 3.0)),
        (".*", (3.0, 3.0, 3.0)),
        ((), (1.0, 1.0, 1.0)),
    ],
)
def test_joints_select_their_actuators(
    make_world: Any, joints: Any, factors: tuple[float, ...], engine: str
) -> None:
    world = make_world(actuators=(POSITION, IDEAL), engine=engine)
    chosen = SceneEntityCfg("robot", joint_names=joints)
    world.apply(dr.pd_gains, kp_range=(3.0, 3.0), kd_range=(1.0, 1.0), asset_cfg=chosen)
    world.apply(dr.effort_limits, effort_limit_range=(3.0, 3.0), asset_cfg=chosen)
    ideal = world.robot.actuators[1]
    gains = [world.sim.model.actuator_gainprm[1, 0, 0] / 20.0, *(ideal.stiffness[1] / 10.0)]
    assert [float(gain) for gain in gains] == pytest.approx(factors)
    limits = world.sim.model.actuator_forcerange[1, :, 1] / torch.tensor([5.0, 4.0, 4.0])
    assert limits.tolist() == pytest.approx(factors)


def with_actuator(element: str) -> str:
    return f"""<mujoco><worldbody><body name="cart"><joint name="slider" type="slide"/>
    <geom size=".1"/></body></worldbody><actuator>{element}</actuator></mujoco>"""


def test_xml_position_actuators_have_gains_and_xml_motors_have_none(make_world: Any) -> None:
    position = with_actuator('<position name="drive" joint="slider" kp="50" kv="5"/>')
    world = make_world(position, actuators=(XmlActuatorCfg(target_names_expr=("slider",)),))
    world.apply(dr.pd_gains, kp_range=(2.0, 2.0), kd_range=(2.0, 2.0))
    assert world.sim.model.actuator_gainprm[0, 0, 0] == 100.0
    assert world.sim.model.actuator_biasprm[0, 0, 2] == -10.0
    motor = with_actuator('<motor name="drive" joint="slider"/>')
    world = make_world(motor, actuators=(XmlActuatorCfg(target_names_expr=("slider",)),))
    with pytest.raises(TypeError, match="XmlActuator with command field 'effort'"):
        world.apply(dr.pd_gains, kp_range=(2.0, 2.0), kd_range=(2.0, 2.0))


XML_SLIDER = (XmlActuatorCfg(target_names_expr=("slider",)),)
XML_MOTORS = {
    "ctrlrange": ('<motor joint="slider" gear="2" ctrlrange="-5 5"/>', 2.0),
    "forcerange": ('<motor joint="slider" forcerange="-5 5"/>', 1.0),
    "both": ('<motor joint="slider" ctrlrange="-5 5" forcerange="-5 5"/>', 1.0),
    "gain": ('<general joint="slider" gainprm="10" ctrlrange="-.5 .5"/>', 1.0),
}


def slider_force(world: Any) -> list[float]:
    """Return the force on the slider in the first two environments, for a large control."""
    world.robot.data.joint_effort_target[:] = 90.0
    world.robot.write_data_to_sim()
    _ = world.sim.data.qfrc_actuator
    world.sim.data.act[:] = 1.0
    world.sim.forward()
    return world.sim.data.qfrc_actuator[:2, 0].tolist()


@pytest.mark.parametrize("kind", XML_MOTORS)
def test_effort_limits_of_xml_motors_act_on_the_joint(make_world: Any, kind: str) -> None:
    element, gear = XML_MOTORS[kind]
    world, chosen = make_world(with_actuator(element), actuators=XML_SLIDER), torch.tensor([1])
    world.apply(dr.effort_limits, chosen, effort_limit_range=(0.5, 0.5))
    assert slider_force(world) == pytest.approx([5.0 * gear, 2.5 * gear])
    world.apply(dr.effort_limits, chosen, effort_limit_range=(3.0, 3.0), operation="abs")
    assert slider_force(world) == pytest.approx([5.0 * gear, 3.0 * gear])


def test_effort_limits_of_xml_muscles_scale_their_force(make_world: Any) -> None:
    muscle = with_actuator('<muscle joint="slider" force="30" lengthrange="-1 1"/>')
    world = make_world(muscle, actuators=XML_SLIDER)
    before = slider_force(world)
    assert before[0] != 0.0
    world.apply(dr.effort_limits, torch.tensor([1]), effort_limit_range=(0.5, 0.5))
    assert slider_force(world) == pytest.approx([before[0], 0.5 * before[0]], rel=1e-4)


def test_xml_motors_without_any_limit_are_refused_by_name(make_world: Any) -> None:
    world = make_world(with_actuator('<motor joint="slider"/>'), actuators=XML_SLIDER)
    with pytest.raises(TypeError, match=r"effort_limits: .*\['slider'\].*forcerange or ctrlrange"):
        world.apply(dr.effort_limits, effort_limit_range=(0.5, 0.5))
