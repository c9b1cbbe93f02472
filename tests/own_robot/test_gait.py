"""Commands and tolerances scale with the leg."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from legged import legged_spec

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.gait import command_ranges, pose_tolerance, step
from mjlab.own_robot.model_source import RobotModel
from mjlab.own_robot.report import describe_robot


def report_of(legs: int, size: float = 1.0):
    return describe_robot(RobotModel(legged_spec(legs, size), "robot", "robot", None, None))


@pytest.mark.parametrize("legs", [2, 4])
def test_twice_the_length(legs):
    small, large = report_of(legs), report_of(legs, 2.0)
    for name, power in (("lin_vel_x", 0.5), ("lin_vel_y", 0.5), ("ang_vel_z", -0.5)):
        ratio = np.array(large.commands.value[name]) / np.array(small.commands.value[name])
        assert ratio == pytest.approx(2.0**power, rel=0.01)
    for joint, tolerance in small.pose_tolerance.value.items():
        assert large.pose_tolerance.value[joint] == pytest.approx(tolerance, abs=0.03)


def test_stock_heights_are_commanded_one_meter_per_second():
    assert command_ranges(0.28, 4).value["lin_vel_x"] == (-1.0, 1.0)
    assert command_ranges(0.76, 2).value["lin_vel_x"] == (-1.0, 1.0)


@pytest.mark.parametrize("legs", [2, 4])
def test_step_moves_the_foot(legs):
    report = report_of(legs)
    model, pose = report.compiled, report.joint_pos.value
    data = mujoco.MjData(model)

    def sole(joint_pos, foot):
        geo.set_pose(model, data, joint_pos)
        link = model.body(foot.link).id
        return data.xpos[link] + data.xmat[link].reshape(3, 3) @ np.array(foot.position)

    offset = np.array([0.05, 0.0, 0.03])
    for leg, foot in zip(report.anatomy.legs.value, report.anatomy.feet.value, strict=True):
        angles = step(model, leg, foot, pose, offset)
        moved = sole(pose | dict(zip(leg.joints, angles, strict=True)), foot)
        assert moved - sole(pose, foot) == pytest.approx(offset, abs=6e-3)


def test_pitch_joints_move_farther_than_roll_joints():
    report = report_of(4)
    pose, height = report.joint_pos.value, report.root_height.value
    tolerance = pose_tolerance(report.compiled, report.anatomy, pose, height).value
    assert tolerance["a0_1"] < tolerance["a0_2"] <= 0.6
    assert tolerance["a0_1"] < tolerance["a0_3"] <= 0.6
