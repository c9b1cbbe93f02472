"""Paired comparison of success, and the judge of episodes."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from deploy_judges import GoalJudge, MotionJudge, PoseJudge, Start, VelocityJudge
from deploy_success import difference_of_success


def test_equal_outcomes_have_an_interval_about_zero():
    by, low, high = difference_of_success([True] * 60, [True] * 60)
    assert by == 0.0
    assert -low == high == pytest.approx(0.0316, abs=1e-4)


def test_difference_is_of_pairs():
    """Zero for equal rates, whichever episodes succeed; negative with more failures in MuJoCo."""
    half = [True, False] * 30
    assert difference_of_success(half, half[::-1])[0] == 0.0
    by, low, high = difference_of_success([True] * 60, half)
    assert by == -0.5
    assert low < by < high < -0.3


# Judges.

XML = """<mujoco><worldbody>
  <body name="robot/trunk"><freejoint/><geom size=".1"/>
    <body name="robot/arm"><joint name="robot/elbow" axis="0 0 1"/><geom size=".1"/>
      <site name="robot/hand" pos=".2 0 0"/></body>
  </body>
  <body name="cube/cube"><freejoint/><geom size=".1"/></body>
</worldbody></mujoco>"""
VELOCITY = [{"name": name} for name in ("lin_vel_x", "lin_vel_y", "ang_vel_z")]
CONTRACT = {
    "robot": {"entity": "robot", "root_body": "robot/trunk", "initial_height": 0.4},
    "limits": {"tilt": 1.0},
    "joints": [{"scene_name": "robot/elbow"}],
    "commands": [{"name": "twist", "kind": "given", "components": VELOCITY}],
}
START = Start({})


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def states(tilt: float = 0.0, height: float = 0.3, turn: float = 0.0) -> tuple:
    """Return two rows of a root that tilts, and moves 0.5 m/s along the world's x axis."""
    qpos, qvel = np.zeros((2, 15)), np.zeros((2, 13))
    qpos[:, 2], qpos[:, 3], qpos[:, 4] = height, math.cos(tilt / 2), math.sin(tilt / 2)
    if turn:
        qpos[:, 3], qpos[:, 6] = math.cos(turn / 2), math.sin(turn / 2)
    qpos[:, 11] = 1.0
    qvel[:, 0] = 0.5
    return qpos, qvel


@pytest.mark.parametrize("change", [{"tilt": 1.1}, {"height": 0.19}])
def test_tilted_and_low_robots_have_fallen(model, change):
    judge = VelocityJudge(CONTRACT, model)
    outcome = judge.outcome(START, *states(**change), {"twist": np.zeros((2, 3))})
    assert not outcome.succeeds
    assert math.isnan(outcome.error)


def test_velocity_error_is_in_the_frame_of_the_root(model):
    """Turned left by 90 degrees, the robot moves to its right."""
    judge, command = VelocityJudge(CONTRACT, model), np.tile((0.0, -0.5, 0.0), (2, 1))
    turned = judge.outcome(START, *states(turn=math.pi / 2), {"twist": command})
    assert turned.error == pytest.approx(0.0)
    straight = judge.outcome(START, *states(), {"twist": command})
    assert straight.error == pytest.approx(0.5 * math.sqrt(2.0))


@pytest.mark.parametrize(
    ("move", "turn", "succeeds"), [(0.04, 0.3, True), (0.06, 0.0, False), (0.0, 0.4, False)]
)
def test_pose_of_the_hand_in_the_frame_of_the_root(model, move, turn, succeeds):
    """In the last step, and within both tolerances."""
    cfg = SimpleNamespace(position_tolerance=0.05, orientation_tolerance=0.35)
    judge = PoseJudge(CONTRACT, model, cfg, ("site", "robot/hand"))
    qpos, qvel = states(turn=1.0)
    qpos[0, :3] = 9.0
    goal = np.zeros((2, 7))
    goal[1] = 0.2, move, 0.0, math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)
    outcome = judge.outcome(START, qpos, qvel, {"hand": goal})
    assert outcome.succeeds == succeeds
    assert outcome.error == pytest.approx(move)


def test_object_is_at_its_goal_in_the_last_step(model):
    judge = GoalJudge(CONTRACT, model, "cube/cube", 0.05)
    qpos, qvel = states()
    qpos[:, 8:11] = (0.0, 0.0, 0.0), (0.5, 0.0, 0.3)
    for goal, succeeds in ((0.34, True), (0.36, False)):
        commands = {"goal": np.tile((0.5, 0.0, goal), (2, 1))}
        outcome = judge.outcome(START, qpos, qvel, commands)
        assert outcome.succeeds == succeeds
        assert outcome.error == pytest.approx(goal - 0.3)


RULES = {
    "bad_anchor_pos_z_only": {"height": 0.56},
    "bad_anchor_ori": {"tilt": 1.5},
    "bad_motion_body_pos_z_only": {"height": 0.56},
}


@pytest.mark.parametrize("rule", RULES)
def test_robot_off_its_motion_fails(model, tmp_path, rule):
    """Frame 3 is that of the first step; later frames than the motion's last do not count."""
    quats = np.zeros((5, 1, 4))
    quats[..., 0] = 1.0
    places = np.full((5, 1, 3), 0.3)
    np.savez(
        tmp_path / "motion.npz",
        joint_pos=np.arange(5.0)[:, None],
        body_pos_w=places,
        body_quat_w=quats,
    )
    command = {"kind": "motion", "file": "motion.npz", "bodies": ["trunk"], "anchor": "trunk"}
    failure = {"function": f"module:{rule}", "is_time_out": False, "params": {"threshold": 0.25}}
    contract = {**CONTRACT, "commands": [command], "terminations": [failure]}
    judge = MotionJudge(contract, model, tmp_path, ("trunk",))
    outcome = judge.outcome(Start({}, frame=3, length=1), *states(), {})
    assert outcome.succeeds
    assert outcome.error == pytest.approx(3.0)
    assert not judge.outcome(Start({}, frame=3, length=1), *states(**RULES[rule]), {}).succeeds


def test_unknown_rules_of_a_failure_are_named(model, tmp_path):
    np.savez(tmp_path / "motion.npz", joint_pos=np.zeros((1, 1)))
    command = {"kind": "motion", "file": "motion.npz"}
    failure = {"function": "module:bad_luck", "is_time_out": False, "params": {}}
    contract = {**CONTRACT, "commands": [command], "terminations": [failure]}
    with pytest.raises(ValueError, match="bad_luck"):
        MotionJudge(contract, model, tmp_path, ())
