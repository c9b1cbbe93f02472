"""Gains hold the weight, and the time step resolves them."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from legged import legged_spec

from mjlab.asset_zoo.robots.unitree_g1.g1_constants import G1_XML
from mjlab.asset_zoo.robots.unitree_go1.go1_constants import GO1_XML
from mjlab.own_robot import geometry as geo
from mjlab.own_robot.gains import (
    MAX_SAG,
    TIMESTEP,
    find_efforts,
    joint_inertias,
    rail_model,
    settle,
    static_torques,
    stiffened,
)
from mjlab.own_robot.model_source import RobotModel
from mjlab.own_robot.report import RobotReport, describe_robot

ROBOTS = ("biped", "quadruped", "hexapod", "large quadruped", "go1", "g1")


@pytest.fixture(scope="module")
def reports() -> dict[str, RobotReport]:
    specs = {
        "biped": legged_spec(2),
        "quadruped": legged_spec(4),
        "hexapod": legged_spec(6),
        "large quadruped": legged_spec(4, size=1.5),
    }
    own = {name: RobotModel(spec, "robot", name, None, None) for name, spec in specs.items()}
    stock = {"go1": str(GO1_XML), "g1": str(G1_XML)}
    return {name: describe_robot(source) for name, source in (own | stock).items()}


def rail_of(report: RobotReport) -> mujoco.MjModel:
    return rail_model(
        report.spec, report.compiled, report.anatomy, report.effort.value, report.armature.value
    )


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_leg_joint_sags(reports, robot):
    report = reports[robot]
    sag = settle(
        rail_of(report),
        report.joint_pos.value,
        report.root_height.value,
        report.stiffness.value,
        report.damping.value,
    )
    assert max(sag[joint] for joint in report.anatomy.leg_joints) <= MAX_SAG


@pytest.mark.parametrize("robot", ["quadruped", "hexapod", "large quadruped", "go1"])
def test_stands_free(reports, robot):
    report = reports[robot]
    model = free_model(report)
    data = mujoco.MjData(model)
    geo.set_pose(model, data, report.joint_pos.value, report.root_height.value)
    for name, position in report.joint_pos.value.items():
        data.ctrl[model.actuator(name).id] = position
    mujoco.mj_step(model, data, 400)
    trunk = model.body(report.anatomy.trunk.value).id
    assert data.xpos[trunk][2] > 0.75 * report.root_height.value
    assert data.xmat[trunk].reshape(3, 3)[2, 2] > 0.98


def low_robot(z: float) -> RobotModel:
    """Return a quadruped with a belly at height `z` in the trunk."""
    spec = legged_spec(4)
    spec.body("trunk").add_geom(
        name="belly", type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.05, 0.05, 0.01), pos=(0, 0, z)
    )
    return RobotModel(spec, "robot", "low", None, None)


def test_low_belly_stays_off_the_ground():
    report = describe_robot(low_robot(-0.28))
    model = free_model(report)
    data = mujoco.MjData(model)
    geo.set_pose(model, data, report.joint_pos.value, report.root_height.value)
    for name, position in report.joint_pos.value.items():
        data.ctrl[model.actuator(name).id] = position
    for _ in range(400):
        mujoco.mj_step(model, data)
        assert model.geom("belly").id not in data.contact.geom


def free_model(report: RobotReport) -> mujoco.MjModel:
    """Return the robot with position servos on a plane."""
    spec = report.spec.copy()
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(5, 5, 0.1), friction=(1, 0, 0))
    for name, kp in report.stiffness.value.items():
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp, kv=report.damping.value[name])
        limit = report.effort.value[name]
        actuator.forcelimited, actuator.forcerange = True, (-limit, limit)
        spec.joint(name).armature = report.armature.value[name]
    for foot in report.anatomy.feet.value:
        for geom in foot.sole:
            spec.geom(geom).condim = 3
    spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec.compile()


def with_servos(spec: mujoco.MjSpec, stiffness: float) -> RobotModel:
    """Return the robot with a position servo per joint."""
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            actuator = spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=stiffness, kv=0.1)
            actuator.forcelimited, actuator.forcerange = True, (-20.0, 20.0)
    return RobotModel(spec, "robot", "servos", None, None)


@pytest.mark.parametrize(("share", "is_kept"), [(0.01, False), (0.15, False), (0.9, True)])
def test_servo_far_below_the_rule_is_a_stand_in(share, is_kept):
    by_rule = describe_robot(with_servos(legged_spec(4), 0.0)).stiffness.value
    own = round(share * max(by_rule.values()), 1)
    found = describe_robot(with_servos(legged_spec(4), own)).stiffness
    assert (own in found.value.values()) == is_kept
    assert (found.value == by_rule) == (not is_kept)
    assert ("file" in {reason.source for reason in found.reasons.values()}) == is_kept


@pytest.mark.parametrize(
    ("belly", "answers", "is_asked"),
    [
        (-0.28, {}, False),
        # Knees that the user made soft are not stiffened, nor the others for them.
        (-0.28, {"stiffness.[ab]0_3": "9"}, True),
        (-0.30, {}, True),
        (-0.30, {"stiffness": "30"}, False),
    ],
)
def test_stiffness_is_asked_if_no_trial_stands(belly, answers, is_asked):
    report = describe_robot(low_robot(belly), answers)
    assert ("stiffness" in {question.key for question in report.questions}) == is_asked
    for setting, value in answers.items():
        pattern = setting.partition(".")[2] or ".*"
        for joint, kp in report.stiffness.value.items():
            assert kp == float(value) or not re.fullmatch(pattern, joint)


def test_stiffened_up_to_a_ceiling():
    stiffness, ceiling = {"hip": 10.0, "knee": 20.0, "ankle": 5.0}, {"hip": 12.0, "knee": 15.0}
    assert stiffened(stiffness, 1.1, ceiling, {"hip"}) == {**stiffness, "hip": 11.0}
    assert stiffened(stiffness, 2.0, ceiling, {"hip"}) == {**stiffness, "hip": 12.0}
    # Above its ceiling already, as far as the sag demands.
    assert stiffened(stiffness, 2.0, ceiling, {"knee"}) == stiffness


@pytest.mark.parametrize("robot", ROBOTS)
def test_time_step_resolves_the_gains(reports, robot):
    report = reports[robot]
    inertia = joint_inertias(report.compiled, report.joint_pos.value, report.armature.value)
    for joint, kp in report.stiffness.value.items():
        # Three digits of the stiffness.
        assert np.sqrt(kp / inertia[joint]) * TIMESTEP <= 1.005


@pytest.mark.parametrize("robot", ROBOTS)
def test_mirror_images_have_equal_gains(reports, robot):
    report = reports[robot]
    for values in (report.stiffness.value, report.damping.value):
        for joint, (partner, _) in report.anatomy.mirror.value.items():
            assert values[joint] == values[partner]


def test_static_torques_are_those_of_stiff_servos(reports):
    report = reports["quadruped"]
    torques = static_torques(report.compiled, report.anatomy, report.joint_pos.value)
    model = rail_of(report)
    # Friction would carry part of the load, and the rail carries moments about the trunk.
    model.geom_friction[:] = 1e-4
    stiff = dict.fromkeys(torques, 300.0)
    sag = settle(
        model, report.joint_pos.value, report.root_height.value, stiff, dict.fromkeys(torques, 10.0)
    )
    for joint in report.anatomy.leg_joints:
        assert 300.0 * sag[joint] == pytest.approx(abs(torques[joint]), rel=0.35, abs=0.2)


def test_tightest_effort_limit():
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><geom size=".1" mass="100"/>
      <joint name="a" actuatorfrcrange="-30 30" actuatorfrclimited="true"/>
      <joint name="b" actuatorfrcrange="-30 30" actuatorfrclimited="true"/>
      <joint name="c"/></body></worldbody><actuator>
      <motor joint="a" gear="2" ctrlrange="-10 10"/>
      <position joint="b" kp="100" ctrlrange="-1 1"/>
      <motor joint="c" gear="2" forcerange="-8 8"/></actuator></mujoco>""")
    limits, questions = find_efforts(model, 1.0)
    assert limits.value == {"a": 20.0, "b": 30.0, "c": 16.0}
    assert questions == []


@pytest.mark.parametrize(
    ("ranges", "asked"),
    [
        ({"a0_1": 5000.0}, "above 3 x weight"),
        ({f"{s}{r}_{n}": 30.0 for s in "ab" for r in (0, 1) for n in (1, 2, 3)}, "for all"),
    ],
)
def test_doubtful_effort_is_asked(ranges, asked):
    spec = legged_spec(4)
    for name, limit in ranges.items():
        spec.actuator(name).ctrlrange = (-limit, limit)
    report = describe_robot(RobotModel(spec, "robot", "robot", None, None))
    (text,) = [q.text for q in report.questions if q.key.startswith("effort")]
    assert asked in text
    assert report.effort.value["a0_1"] < 100.0
