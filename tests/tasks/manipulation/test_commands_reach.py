"""Reach of an arm, and warnings of goals beyond it."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from lifting_tasks import LIFT, MULTI

from mjlab.asset_zoo.robots import get_yam_robot_cfg
from mjlab.tasks.manipulation.mdp.commands import reach


@pytest.fixture(scope="module")
def arm() -> mujoco.MjModel:
    return get_yam_robot_cfg().build().compile()


def test_no_pose_of_the_joints_reaches_further(arm):
    center, longest = reach(arm, "grasp_site")
    data = mujoco.MjData(arm)
    generator = np.random.default_rng(0)
    low, high = arm.jnt_range.T
    farthest = 0.0
    for _ in range(2000):
        data.qpos[:] = generator.uniform(low, high)
        mujoco.mj_kinematics(arm, data)
        farthest = max(farthest, math.dist(data.site("grasp_site").xpos, center))
    # The bound holds, and exceeds the reach of random poses by at most a quarter.
    assert farthest <= longest < 1.25 * farthest


def test_the_reach_of_a_plain_arm_is_the_length_of_its_links_and_slides():
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><worldbody><body pos="0 0 1"><joint type="hinge" axis="0 0 1"/><geom size="0.1"/>
        <body pos="0.5 0 0"><joint type="hinge" axis="0 1 0"/><geom size="0.1"/>
          <body pos="0 0 0.2"><joint type="slide" axis="0 0 1" range="-0.1 0.3"/><geom size="0.1"/>
            <site name="hand" pos="0 0.3 0.2"/></body></body></body></worldbody></mujoco>
    """)
    center, longest = reach(model, "hand")
    assert center.tolist() == [0.0, 0.0, 1.0]
    assert longest == pytest.approx(0.5 + math.hypot(0.3, 0.4) + 0.3)


def test_a_slide_reaches_from_where_the_model_puts_it():
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><worldbody><body>
        <joint type="slide" ref="0.5" range="0 0.6"/><geom size="0.1"/><site name="hand"/>
      </body></worldbody></mujoco>
    """)
    # Back by 0.5 and forward by 0.1.
    assert reach(model, "hand")[1] == pytest.approx(0.5)


@pytest.mark.parametrize(
    "joint", ["<freejoint/>", '<joint type="slide"/>'], ids=["floating", "endless slide"]
)
def test_what_can_go_anywhere_has_no_reach(joint):
    model = mujoco.MjModel.from_xml_string(f"""
      <mujoco><worldbody><body>{joint}<geom size="0.1"/><site name="hand"/></body></worldbody>
      </mujoco>
    """)
    assert reach(model, "hand") is None


@pytest.mark.parametrize("task", [LIFT, MULTI])
@pytest.mark.parametrize("what", ["target_position_range", "object_pose_range"])
def test_places_beyond_the_reach_warn(make_env, task, what):
    def edit(cfg):
        command = cfg.commands["lift_height"]
        command.object_pose_range = command.object_pose_range or type(command).ObjectPoseRangeCfg()
        getattr(command, what).x = (0.3, 1.2)

    thing = "goals" if what.startswith("target") else "objects"
    # Each term that reads goal and hand warns.
    term = "'lift'" if task == LIFT else "'actor/goal_position'"
    with pytest.warns(UserWarning, match=f"(?s){term}.*{thing}: .*got .* at .1.2,.*{what}"):
        make_env(task, edit=edit, images=False)


def test_a_fixed_goal_is_in_reach_whatever_the_range_of_others(make_env):
    def edit(cfg):
        cfg.commands["lift_height"].difficulty = "fixed"
        cfg.commands["lift_height"].target_position_range.x = (5.0, 6.0)

    make_env(edit=edit)


def test_fixed_goal_too_far_from_the_arm_warns(make_env):
    def edit(cfg):
        cfg.commands["lift_height"].difficulty = "fixed"
        cfg.scene.entities["robot"].init_state.pos = (-1.0, 0.0, 0.01)

    with pytest.warns(UserWarning, match=r"(?s)'lift'.*goals: .*\(0.4, 0.0, 0.3\).*nearer"):
        make_env(edit=edit)


def test_goal_that_is_only_observed_warns(make_env):
    def edit(cfg):
        del cfg.rewards["lift"]
        cfg.commands["lift_height"].target_position_range.x = (0.3, 1.2)

    with pytest.warns(UserWarning, match="(?s)'actor/goal_position'.*goals: .* at .1.2,"):
        make_env(MULTI, edit=edit, images=False)
