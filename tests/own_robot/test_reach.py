"""Homes and stands of arms."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from small_robots import arm_spec

from mjlab.asset_zoo.robots.i2rt_yam.yam_constants import YAM_XML
from mjlab.own_robot import geometry as geo
from mjlab.own_robot.model_source import RobotModel
from mjlab.own_robot.reach import stand_height
from mjlab.own_robot.report import RobotReport, describe_robot


@pytest.fixture(scope="module", params=["crane", "yam"])
def report(request) -> RobotReport:
    crane = RobotModel(arm_spec(), "crane", "crane", None, None)
    return describe_robot(crane if request.param == "crane" else str(YAM_XML))


def test_home_is_bent_and_free_of_contact(report):
    model, (hand,) = report.compiled, report.anatomy.hands.value
    assert report.joint_pos.source == "asked"
    data = mujoco.MjData(model)
    geo.set_pose(model, data, report.joint_pos.value)
    mujoco.mj_collision(model, data)
    assert data.ncon == 0
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], model.body(hand.link).id)
    dofs = [model.jnt_dofadr[model.joint(j).id] for j in hand.joints]
    assert np.linalg.svd(jacobian[:3, dofs], compute_uv=False)[-1] > 0.05
    # No two axes of the wrist are parallel: the hand can turn about all axes.
    assert np.linalg.svd(jacobian[:, dofs], compute_uv=False)[-1] > 0.05


def test_keyframe_is_the_home():
    spec = arm_spec()
    spec.add_key(name="home", qpos=[0.0, 0.5, 0.7, 0.0, 0.3, 0.0])
    report = describe_robot(RobotModel(spec, "crane", "crane", None, None))
    assert report.joint_pos.source == "file"
    assert report.joint_pos.value["joint2"] == 0.7


def test_hanging_arm_has_a_stand():
    spec = arm_spec()
    spec.body("base").quat = (0, 1, 0, 0)
    report = describe_robot(RobotModel(spec, "crane", "crane", None, None))
    model = report.compiled
    assert stand_height(model, report.anatomy) == report.root_height.value > 0.8


def test_answered_home():
    settings = {"pose.joint1": "0.5", "pose.joint2": "0.6"}
    report = describe_robot(RobotModel(arm_spec(), "crane", "crane", None, None), settings)
    assert report.joint_pos.value["joint1"] == 0.5
    (question,) = [question for question in report.questions if question.key == "pose"]
    # The value in use answers the question as it is printed.
    crane = RobotModel(arm_spec(), "crane", "crane", None, None)
    answered = describe_robot(crane, {"pose": question.used})
    assert answered.joint_pos.value == pytest.approx(report.joint_pos.value)
    assert "pose" not in {question.key for question in answered.questions}
