"""Pose command: goals that can be reached, and metrics counted at the end of goals."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from mjlab.entity import EntityCfg
from mjlab.envs import mdp
from mjlab.envs.mdp import UniformPoseCommandCfg
from mjlab.envs.mdp.reachable_poses import joint_bounds
from mjlab.utils.lab_api.math import (
    quat_apply,
    quat_box_plus,
    quat_error_magnitude,
    quat_from_euler_xyz,
    quat_inv,
    quat_mul,
    random_orientation,
    subtract_frame_transforms,
)

# Two hinges and a slide that carry a hand over a floor; the tail does not move it.
ARM_XML = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body name="base" pos="0 0 .3" euler="0 0 .5">
      <geom type="box" size=".05 .05 .05" contype="0" conaffinity="0"/>
      <body name="upper" pos="0 0 .1">
        <joint name="shoulder" axis="0 1 0" range="-3 1"/>
        <geom name="upper" type="capsule" size=".02" fromto="0 0 0 .3 0 0" contype="0" conaffinity="0"/>
        <body name="fore" pos=".3 0 0">
          <joint name="elbow" axis="0 0 1" range="-1 2"/>
          <geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" contype="0" conaffinity="0"/>
          <body name="hand" pos=".2 0 0">
            <joint name="wrist" type="slide" axis="1 0 0" range="0 .1"/>
            <geom name="palm" type="sphere" size=".04"/>
            <site name="grasp" pos=".05 0 0" euler=".1 .2 .3"/>
          </body>
        </body>
      </body>
      <body name="tail" pos="-.2 0 0">
        <joint name="tail" axis="0 1 0" range="-1 1"/><geom size=".02"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
# Three parallel hinges: the elbow can bend both ways to the same pose.
FLIPPING_XML = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 .5">
      <geom size=".02" contype="0" conaffinity="0"/>
      <body name="upper">
        <joint name="shoulder" axis="0 1 0" range="-6.28 6.28"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 .3" contype="0" conaffinity="0"/>
        <body name="fore" pos="0 0 .3">
          <joint name="elbow" axis="0 1 0" range="-3.1 3.1"/>
          <geom type="capsule" size=".02" fromto="0 0 0 0 0 .3" contype="0" conaffinity="0"/>
          <body name="hand" pos="0 0 .3">
            <joint name="wrist" axis="0 1 0" range="-6.28 6.28"/>
            <geom size=".03" contype="0" conaffinity="0"/>
            <site name="grasp" pos="0 0 .1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
HOME = {"shoulder": 0.6, "elbow": 1.2, "wrist": math.pi - 1.8}
RANGES = UniformPoseCommandCfg.Ranges(
    pos_x=(0.1, 0.2), pos_y=(-0.3, 0.3), pos_z=(0.4, 0.4), yaw=(-math.pi, math.pi)
)
NUM_ENVS = 4
# Ten steps of 0.02 s, whatever the rounding.
GOAL_TIME = 0.19


def make_arm(make_world: Any, engine: str = "native") -> Any:
    state = EntityCfg.InitialStateCfg(joint_pos={"shoulder": -0.4, "elbow": 0.3, "tail": 0.7})
    arm = make_world(ARM_XML, num_envs=NUM_ENVS, engine=engine, init_state=state)
    arm.robot.write_joint_state_to_sim(
        arm.robot.data.default_joint_pos, arm.robot.data.default_joint_vel
    )
    arm.sim.forward()
    return arm


def make_term(arm: Any, **fields: Any) -> Any:
    fields = {"frame_type": "site", "frame_name": "grasp", **fields}
    fields.setdefault("resampling_time_range", (GOAL_TIME, GOAL_TIME))
    term = UniformPoseCommandCfg(entity_name="robot", **fields).build(arm)
    term.reset(None)
    manager = SimpleNamespace(get_term=lambda name: {"hand": term}[name])
    arm.command_manager = manager
    return term


def set_goal(term: Any, shift: float, angle: float) -> None:
    """Set goals at a distance (m) and angle (rad) from the frame."""
    position, quat = term.pose_b
    turn = torch.tensor([0.0, angle, 0.0]).expand(NUM_ENVS, 3)
    term.pose_command_b[:, :3] = position + torch.tensor([0.0, 0.0, shift])
    term.pose_command_b[:, 3:] = quat_box_plus(quat, turn)


# Goals.


def test_uniform_goals_lie_in_their_ranges(make_world: Any) -> None:
    term = make_term(make_arm(make_world), ranges=RANGES)
    drawn = term._draw(500)
    low, high = torch.tensor([0.1, -0.3, 0.4]), torch.tensor([0.2, 0.3, 0.4])
    assert ((drawn[:, :3] >= low - 1e-6) & (drawn[:, :3] <= high + 1e-6)).all()
    assert (drawn[:, 3] >= 0.0).all()
    # Only yaw is drawn, from a whole turn.
    assert drawn[:, 4:6].abs().max() < 1e-6
    assert drawn[:, 6].max() > 0.9
    assert drawn[:, 6].min() < -0.9


def test_goals_without_ranges_can_be_reached(make_world: Any) -> None:
    arm = make_arm(make_world)
    goals = make_term(arm, num_goals=200).goals
    model, data = arm.sim.mj_model, mujoco.MjData(arm.sim.mj_model)
    base, site = model.body("base"), model.site("grasp")
    # The root frame of an entity without free joint is the world's.
    for goal in goals[:20].double().numpy():
        best = np.inf
        in_base = subtract_frame_transforms(
            *(torch.tensor(v).double() for v in (base.pos, base.quat, goal[:3], goal[3:]))
        )
        for q in candidates(torch.cat(in_base).numpy(), site.quat):
            data.qpos[:] = *q, 0.7
            mujoco.mj_forward(model, data)
            if data.ncon == 0:
                best = min(best, np.abs(data.site("grasp").xpos - goal[:3]).max())
        assert best < 1e-4


def test_goals_are_reached_at_their_joint_positions(make_world: Any) -> None:
    arm = make_arm(make_world)
    term = make_term(arm, num_goals=50)
    joints, robot = term.joint_ids, arm.scene["robot"]
    joint_pos = robot.data.joint_pos.clone()
    joint_pos[:, joints] = term.goal_joint_pos + torch.tensor([0.1, -0.2, 0.01])
    robot.write_joint_state_to_sim(joint_pos, torch.zeros_like(joint_pos))
    arm.sim.forward()
    deviation = mdp.goal_joint_deviation_l1(arm, "hand")
    torch.testing.assert_close(deviation, torch.full((NUM_ENVS,), 0.31))
    joint_pos[:, joints] = term.goal_joint_pos
    robot.write_joint_state_to_sim(joint_pos, torch.zeros_like(joint_pos))
    arm.sim.forward()
    assert max(error.max() for error in term.errors()) < 1e-3
    make_term(arm, ranges=RANGES)
    with pytest.raises(ValueError, match="ranges"):
        mdp.goal_joint_deviation_l1(arm, "hand")


def test_hinges_turn_by_a_quarter_from_home() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><compiler angle="radian"/><worldbody><body>
        <joint range="-6.3 6.3"/><joint axis="0 1 0"/><joint axis="1 0 0" range="-1 1"/>
        <joint type="slide" range="-5 5"/><geom size="0.1"/></body></worldbody></mujoco>"""
    )
    quarter = 0.5 * math.pi
    low, high = joint_bounds(model, np.arange(4), 0.8, np.array([4.0, 1.0, 0.0, 0.0]))
    np.testing.assert_allclose(low, [4.0 - quarter, 1.0 - quarter, -0.8, -4.0])
    np.testing.assert_allclose(high, [5.04, 1.0 + quarter, 0.8, 4.0])


def test_joint_positions_at_goals_follow_from_home(make_world: Any) -> None:
    """Goals that differ little have joint positions that differ little, though an elbow could flip."""
    robot = make_world(FLIPPING_XML, init_state=EntityCfg.InitialStateCfg(joint_pos=HOME))
    term = make_term(robot, num_goals=200)
    home = torch.tensor([HOME[name] for name in ("shoulder", "elbow", "wrist")])
    model, data = robot.sim.mj_model, mujoco.MjData(robot.sim.mj_model)
    for goal, joint_pos in zip(term.goals, term.goals_joint_pos, strict=True):
        data.qpos[:] = joint_pos.numpy()
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.site("grasp").xpos, goal[:3], atol=0.02)
    # Bent one way, as at home: of the positions drawn, a seventh are bent the other way.
    is_bent = (term.goals_joint_pos[:, 1] > 0.0).float().mean()
    assert is_bent > 0.95
    assert (term.goals_joint_pos - home).abs().max() < 2.0


def test_quaternions_of_goals_are_near_that_of_home(make_world: Any) -> None:
    term = make_term(make_world(FLIPPING_XML, init_state=EntityCfg.InitialStateCfg(joint_pos=HOME)))
    # At home the hand points down: w = 0.
    reference = quat_from_euler_xyz(*torch.tensor([0.0, math.pi, 0.0]))
    dots = term.goals[:, 3:] @ reference
    assert (dots >= -1e-3).all() or (dots <= 1e-3).all()
    assert term.goals[:, 3].min() < -0.1 < 0.1 < term.goals[:, 3].max()


def candidates(goal: np.ndarray, site_quat: np.ndarray) -> list[np.ndarray]:
    """Return the joint positions, in the middle 80 % of their ranges, that a goal's orientation leaves.

    The goal is in the frame of the base. Shoulder and elbow set the direction x of the hand, which
    leaves the slide along it.
    """
    hand = quat_mul(torch.tensor(goal[3:]), quat_inv(torch.tensor(site_quat)))
    x = quat_apply(hand, torch.tensor([1.0, 0.0, 0.0]).double()).numpy()
    elbow = math.asin(x[1])
    found = []
    for e in (elbow, math.pi - elbow):
        shoulder = math.atan2(-x[2] / math.cos(e), x[0] / math.cos(e))
        along = (
            goal[:3] - [0, 0, 0.1] - 0.3 * np.array([math.cos(shoulder), 0.0, -math.sin(shoulder)])
        )
        slide = along @ x - 0.25
        if -2.6 <= shoulder <= 0.6 and -0.7 <= e <= 1.7 and 0.01 <= slide <= 0.09:
            found.append(np.array([shoulder, e, slide]))
    return found


def test_goals_cover_the_middle_of_the_ranges(make_world: Any) -> None:
    arm = make_arm(make_world)
    narrow, wide = (make_term(arm, joint_range_fraction=f).goals for f in (0.2, 1.0))
    assert narrow[:, :3].std(dim=0).sum() < 0.4 * wide[:, :3].std(dim=0).sum()
    # The palm, of radius 0.04 m and 0.05 m behind the site, stays above the floor.
    assert wide[:, 2].min() > -0.011


def test_goals_follow_the_seed(make_world: Any) -> None:
    arm = make_arm(make_world)
    torch.manual_seed(3)
    one = make_term(arm, num_goals=10).goals
    torch.manual_seed(3)
    other = make_term(arm, num_goals=10).goals
    assert torch.equal(one, other)
    assert not torch.equal(one, make_term(arm, num_goals=10).goals)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"frame_name": "thumb"}, "thumb"),
        ({"frame_type": "bone"}, "frame_type"),
        ({"frame_type": "body", "frame_name": "base"}, "moved by joints"),
        ({"joint_range_fraction": 1.5}, "joint_range_fraction"),
        ({"num_goals": 0}, "num_goals"),
    ],
)
def test_bad_settings(make_world: Any, fields: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        make_term(make_arm(make_world), **fields)


# Errors.


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("frame", [("site", "grasp"), ("body", "hand"), ("geom", "palm")])
def test_no_error_at_the_goal(make_world: Any, engine: str, frame: tuple[str, str]) -> None:
    arm = make_arm(make_world, engine)
    term = make_term(arm, frame_type=frame[0], frame_name=frame[1], ranges=RANGES)
    arm.sim.forward()
    position, quat = term.pose_b
    term.pose_command_b[:] = torch.cat((position, -quat), dim=1)
    distance, angle = term.errors()
    assert distance.max() < 1e-6
    assert angle.max() < 1e-3
    assert mdp.pose_command_error(arm, "hand").abs().max() < 1e-3
    goal, goal_quat = term.pose_command_w
    torch.testing.assert_close(goal, term.frame.pos, atol=1e-6, rtol=0.0)
    assert quat_error_magnitude(goal_quat, term.frame.quat).max() < 1e-3


def test_errors_of_a_shifted_goal(make_world: Any) -> None:
    arm = make_arm(make_world)
    term = make_term(arm, ranges=RANGES)
    arm.sim.forward()
    set_goal(term, shift=0.1, angle=0.4)
    error = mdp.pose_command_error(arm, "hand")
    expected = torch.tensor([0.0, 0.0, 0.1, 0.0, 0.4, 0.0]).expand(NUM_ENVS, 6)
    torch.testing.assert_close(error, expected, atol=1e-5, rtol=0.0)
    four = torch.ones(NUM_ENVS)
    torch.testing.assert_close(mdp.position_command_error(arm, "hand"), 0.1 * four)
    torch.testing.assert_close(mdp.orientation_command_error(arm, "hand"), 0.4 * four)
    closeness = mdp.position_command_error_tanh(arm, "hand", std=0.1)
    torch.testing.assert_close(closeness, (1.0 - math.tanh(1.0)) * four)
    closeness = mdp.orientation_command_error_tanh(arm, "hand", std=0.2)
    torch.testing.assert_close(closeness, (1.0 - math.tanh(2.0)) * four)


def test_the_orientation_error_is_a_metric() -> None:
    a, b, c = (random_orientation(200, "cpu") for _ in range(3))
    angle = quat_error_magnitude
    torch.testing.assert_close(angle(a, b), angle(b, a))
    assert angle(a, -a).max() < 1e-3
    assert (angle(a, c) <= angle(a, b) + angle(b, c) + 1e-5).all()
    assert (angle(a, b) <= math.pi + 1e-5).all()


def test_other_commands_have_no_pose(make_world: Any) -> None:
    arm = make_arm(make_world)
    arm.command_manager = SimpleNamespace(get_term=lambda name: SimpleNamespace())
    with pytest.raises(TypeError, match="UniformPoseCommand"):
        mdp.pose_command_error(arm, "hand")


# Metrics at the end of goals.


def pass_time(term: Any, steps: int, shift: float, angle: float = 0.0) -> None:
    """Advance by steps of 0.02 s with the goals at a constant distance and angle."""
    for _ in range(steps):
        set_goal(term, shift, angle)
        term.compute(0.02)


def test_errors_count_at_the_end_of_each_goal(make_world: Any) -> None:
    arm = make_arm(make_world)
    term = make_term(arm, ranges=RANGES)
    arm.sim.forward()
    # Three goals of ten steps: far until the last step, then missed by 0.3 m, by an angle, and met.
    pass_time(term, 1, 0.5)
    assert term.metrics["end_position_error"].tolist() == [0.0] * NUM_ENVS
    for steps, shift, angle in ((8, 0.3, 0.0), (9, 0.0, 0.5), (9, 0.03, 0.1)):
        pass_time(term, steps, 0.5)
        pass_time(term, 1, shift, angle)
    assert (term.command_counter == 4).all()
    pass_time(term, 1, 0.7)
    log = term.reset(torch.arange(NUM_ENVS))
    assert log["goals_reached"] == pytest.approx(1 / 3)
    assert log["end_position_error"] == pytest.approx((0.3 + 0.0 + 0.03) / 3, abs=1e-5)
    assert log["end_orientation_error"] == pytest.approx((0.0 + 0.5 + 0.1) / 3, abs=2e-3)
    assert log["position_error"] == pytest.approx(0.7, abs=1e-5)


def test_the_last_goal_of_an_episode_counts(make_world: Any) -> None:
    arm = make_arm(make_world)
    term = make_term(arm, resampling_time_range=(2.0, 3.0), ranges=RANGES)
    arm.sim.forward()
    # The step that ends the episode resets the term before it computes.
    pass_time(term, 99, 0.02)
    assert term.reset(torch.tensor([0, 1]))["goals_reached"] == 1.0
    # A goal cut short does not count, nor does the old episode in the new one.
    pass_time(term, 30, 0.5)
    assert term.metrics["position_error"][0] > 0.4
    assert term.reset(torch.tensor([0, 2]))["goals_reached"] == 0.0
    assert term.num_ended[:2].tolist() == [0.0, 0.0]


def test_the_exported_frame(make_world: Any) -> None:
    term = make_term(make_arm(make_world), ranges=RANGES)
    assert term.export_metadata("hand") == {
        "pose_command": "hand",
        "pose_frame": "site robot/grasp",
        "pose_reference_quat": [1.0, 0.0, 0.0, 0.0],
    }
