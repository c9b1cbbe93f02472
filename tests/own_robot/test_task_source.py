"""Bounds and weights of the joints of bipeds by their role."""

from __future__ import annotations

import mujoco
import pytest
from legged import legged_spec

from mjlab.own_robot.model_source import RobotModel
from mjlab.own_robot.report import RobotReport, describe_robot
from mjlab.own_robot.task_source import has_ankles, leg_limits

SIDES = ("a0", "b0")


def report_of(spec: mujoco.MjSpec) -> RobotReport:
    return describe_robot(RobotModel(spec, "robot", "robot", None, None))


def test_legs_that_do_not_turn_have_no_yaw_joint() -> None:
    """The axis of a hip's roll is the most vertical one, by chance, and not vertical."""
    bounds, pose = leg_limits(report_of(legged_spec(2)))
    for side in SIDES:
        assert (bounds[f"{side}_1"], pose[f"{side}_1"]) == (0.6, 1.0)


def test_weight_of_a_joint_that_turns_the_leg() -> None:
    spec = legged_spec(2)
    for side in SIDES:
        spec.joint(f"{side}_1").axis = (0.1, 0.0, 1.0)
    bounds, pose = leg_limits(report_of(spec))
    for side in SIDES:
        assert (bounds[f"{side}_1"], pose[f"{side}_1"]) == (0.6, 5.0)


@pytest.mark.parametrize("below_the_knee", [True, False])
def test_ankles(below_the_knee: bool) -> None:
    spec = legged_spec(2)
    if not below_the_knee:
        for side in SIDES:
            spec.delete(spec.actuator(f"{side}_4"))
            spec.delete(spec.joint(f"{side}_4"))
    assert has_ankles(report_of(spec)) == below_the_knee
