"""Values of a task for the stock robots."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from legged import legged_spec
from small_robots import arm_spec

from mjlab.asset_zoo.robots.i2rt_yam.yam_constants import YAM_XML
from mjlab.asset_zoo.robots.unitree_g1.g1_constants import G1_XML
from mjlab.asset_zoo.robots.unitree_go1.go1_constants import GO1_XML
from mjlab.own_robot.model_source import RobotModel
from mjlab.own_robot.report import describe_robot
from mjlab.own_robot.robot_source import imu_site, robot_source
from mjlab.utils.errors import UnknownNameError


@pytest.mark.parametrize(
    ("file", "kind", "feet"), [(GO1_XML, "legged", 4), (G1_XML, "legged", 2), (YAM_XML, "arm", 0)]
)
def test_kind(file, kind, feet):
    report = describe_robot(str(file))
    assert report.anatomy.kind.value == kind
    assert len(report.anatomy.feet.value) == feet


def test_settings_answer_questions():
    asked = describe_robot(str(GO1_XML))
    assert {question.key for question in asked.questions} >= {"effort", "armature"}
    settings = {"effort": "23.7", "armature": "0.004", "pose.FL_calf_joint": "-1.8"}
    report = describe_robot(str(GO1_XML), settings)
    assert set(report.effort.value.values()) == {23.7}
    assert report.effort.source == "set"
    assert report.joint_pos.value["FL_calf_joint"] == -1.8
    assert not {question.key for question in report.questions} & {"effort", "armature"}


def test_unknown_setting():
    with pytest.raises(UnknownNameError, match="did you mean 'effort'"):
        describe_robot(str(GO1_XML), {"efort": "1"})
    with pytest.raises(UnknownNameError, match="FL_calf_joint"):
        describe_robot(str(GO1_XML), {"effort.FL_kalf_joint": "1"})


def test_no_torch():
    code = "import sys, mjlab.own_robot.report; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def small(spec) -> RobotModel:
    return RobotModel(spec, "robot", "robot", None, None)


@pytest.mark.parametrize(
    "setting",
    [
        "floating_base=maybe",
        "kind.foo=legged",
        "root_height.x=0.5",
        "root_height=abc",
        "effort=-3",
        "effort.*calf=23",
        "stiffness=0",
        "kind=arm",
        "imu_site=elsewhere",
        "imu_site=turned",
        "pose.a._3=1,2,3",
    ],
)
def test_errors_name_the_setting(setting):
    spec = legged_spec(4)
    spec.body("a0_calf").add_site(name="elsewhere")
    spec.body("trunk").add_site(name="turned", quat=(0, 0, 0, 1))
    key, value = setting.split("=")
    with pytest.raises(ValueError, match=f"Setting {key.replace('*', '[*]')}"):
        describe_robot(small(spec), {key: value})


@pytest.mark.parametrize("setting", ["front", "imu_site"])
def test_settings_of_legs_are_not_of_arms(setting):
    value = {"front": "-x", "imu_site": "trunk"}[setting]
    with pytest.raises(ValueError, match=f"Setting {setting}: expected .* legged"):
        describe_robot(small(arm_spec()), {setting: value})


def fixed_quadruped():
    """Return a quadruped whose file fixes its trunk, with a keyframe."""
    spec = legged_spec(4)
    (free,) = spec.body("trunk").joints
    spec.delete(free)
    spec.add_key(name="home", qpos=[0.0, 0.7, -1.4] * 4)
    return spec


def test_legs_of_a_fixed_base_are_asked():
    report = describe_robot(small(fixed_quadruped()))
    assert "floating_base" in {question.key for question in report.questions}
    assert report.anatomy.kind.value == "other"
    assert "floating_base" not in {q.key for q in describe_robot(small(arm_spec())).questions}


@pytest.mark.parametrize("setting", [("floating_base", "y"), ("kind", "legged"), None])
def test_fixed_base_floats(setting):
    spec = fixed_quadruped()
    if setting is None:
        # A name of a leg's joint.
        for joint in spec.joints:
            joint.name = f"{joint.name}_HFE"
        for actuator in spec.actuators:
            actuator.target = f"{actuator.target}_HFE"
    report = describe_robot(small(spec), dict([setting]) if setting else {})
    assert report.anatomy.kind.value == "legged"
    assert report.compiled.nq == 7 + 12
    # The keyframe counts.
    assert report.joint_pos.source == "file"
    assert "add_freejoint" in robot_source(report, "Robot", Path("robot.xml"))


def test_answer_of_one_joint_is_its_own():
    settings = {"stiffness.a0_3": "70.125", "action_scale.a0_3": "0.31"}
    asked, report = (
        describe_robot(small(legged_spec(4))),
        describe_robot(small(legged_spec(4)), settings),
    )
    assert report.stiffness.value["a0_3"] == 70.125
    assert report.stiffness.value["b0_3"] == pytest.approx(asked.stiffness.value["b0_3"], rel=0.05)
    source = robot_source(report, "Robot", Path("robot.xml"))
    assert source.count("stiffness=70.125,") == 1
    assert source.count(": 0.31,") == 1


def test_each_joint_has_its_own_reason():
    settings = {"effort.a0_3": "12", "pose.b0_2": "0.8", "armature.a0_1": "0.01"}
    report = describe_robot(small(legged_spec(4)), settings)
    for key, guess in (
        ("effort", report.effort),
        ("pose", report.joint_pos),
        ("armature", report.armature),
    ):
        answered = {name for name in guess.value if f"{key}.{name}" in settings}
        assert len(answered) == 1
        assert {n for n, reason in guess.reasons.items() if reason.source == "set"} == answered


@pytest.mark.parametrize(
    ("effort", "word"),
    [
        (60.0, "effort limit"),
        # What holds the weight counts if motors are weak; the time step, if they are strong.
        (2.0, "weight"),
        (3000.0, "time step"),
    ],
)
def test_reason_of_the_stiffness_is_the_rule_that_won(effort, word):
    spec = legged_spec(4)
    for actuator in spec.actuators:
        actuator.ctrlrange = (-effort, effort)
    setting = {"effort": str(effort)}
    reasons = describe_robot(small(spec), setting).stiffness.reasons
    assert word in reasons["a0_3"].rule


@pytest.mark.parametrize(("setting", "site"), [("chest", "chest"), ("trunk", None)])
def test_answer_to_the_imu_is_used(setting, site):
    spec = legged_spec(4)
    spec.body("trunk").add_site(name="chest", pos=(0.1, 0, 0))
    report = describe_robot(small(spec), {"imu_site": setting})
    assert report.anatomy.imu_site.value == site
    found, _ = imu_site(report)
    assert found == (site or "imu")
    assert "imu_site" not in {question.key for question in report.questions}
