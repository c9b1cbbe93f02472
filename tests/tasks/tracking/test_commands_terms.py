"""Observations, rewards, terminations and errors at poses with known values."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from tracking_tasks import task_cfg, unperturbed

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.tracking import mdp
from mjlab.utils.lab_api.math import matrix_from_quat, quat_from_euler_xyz, quat_mul

HANDS = ("left_wrist_yaw_link", "right_wrist_yaw_link")


@pytest.fixture(scope="module")
def env():
    env = ManagerBasedRlEnv(task_cfg("wave", num_envs=2, edit=unperturbed), device="cpu")
    env.reset()
    yield env
    env.close()


def command_of(env):
    return env.command_manager.get_term("motion")


@pytest.fixture
def place(env):
    """Put the robots onto frame 90, displaced in the world."""

    def put(shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), velocity=(0.0,) * 6):
        command = command_of(env)
        command.reset_to_frame(torch.arange(2), 90)
        env.sim.forward()
        data = command.robot.data
        quat = quat_from_euler_xyz(*torch.tensor(turn)).expand(2, 4)
        # About the anchor, so that the anchor does not move.
        anchor = command.anchor_pos_w
        away = data.root_link_pos_w - anchor
        pos = anchor + (matrix_from_quat(quat) @ away[..., None])[..., 0] + torch.tensor(shift)
        speed = data.root_link_vel_w + torch.tensor(velocity)
        turned = quat_mul(quat, data.root_link_quat_w)
        data.write_root_state(torch.cat((pos, turned, speed), dim=1))
        env.sim.forward()
        command.update_relative_body_poses()
        return command

    return put


def value(term) -> float:
    assert term.shape == (2,)
    assert term[0].item() == pytest.approx(term[1].item(), abs=1e-4)
    return term[0].item()


def test_on_the_reference_all_rewards_are_one_and_nothing_ends(env, place):
    place()
    for name in (
        "motion_global_anchor_position_error_exp",
        "motion_global_anchor_orientation_error_exp",
        "motion_relative_body_position_error_exp",
        "motion_relative_body_orientation_error_exp",
        "motion_global_body_linear_velocity_error_exp",
        "motion_global_body_angular_velocity_error_exp",
    ):
        assert value(getattr(mdp, name)(env, "motion", 0.3)) == pytest.approx(1.0, abs=1e-3), name
    robot = SimpleNamespace(name="robot")
    assert not mdp.bad_anchor_pos(env, "motion", 0.01).any()
    assert not mdp.bad_anchor_pos_z_only(env, "motion", 0.01).any()
    assert not mdp.bad_anchor_ori(env, robot, "motion", 0.01).any()
    assert not mdp.bad_motion_body_pos(env, "motion", 0.01).any()


def test_the_anchors_position_is_compared_in_the_world(env, place):
    place(shift=(0.3, 0.0, 0.0))
    reward = mdp.motion_global_anchor_position_error_exp(env, "motion", 0.3)
    assert value(reward) == pytest.approx(math.exp(-1.0), abs=1e-4)
    assert mdp.bad_anchor_pos(env, "motion", 0.29).all()
    assert not mdp.bad_anchor_pos(env, "motion", 0.31).any()
    assert not mdp.bad_anchor_pos_z_only(env, "motion", 0.01).any()
    # Bodies are compared with the relative reference.
    near = mdp.motion_relative_body_position_error_exp(env, "motion", 0.3)
    assert value(near) == pytest.approx(1.0, abs=1e-4)


def test_the_anchors_orientation_is_compared_in_the_world(env, place):
    place(turn=(0.0, 0.0, 0.4))
    reward = mdp.motion_global_anchor_orientation_error_exp(env, "motion", 0.4)
    assert value(reward) == pytest.approx(math.exp(-1.0), abs=1e-4)
    near = mdp.motion_relative_body_orientation_error_exp(env, "motion", 0.4)
    assert value(near) == pytest.approx(1.0, abs=1e-4)
    assert not mdp.bad_anchor_ori(env, SimpleNamespace(name="robot"), "motion", 0.01).any()


def test_heights_of_bodies_are_compared_with_the_reference(env, place):
    place(shift=(0.0, 0.0, 0.2))
    reward = mdp.motion_relative_body_position_error_exp(env, "motion", 0.2)
    assert value(reward) == pytest.approx(math.exp(-1.0), abs=1e-4)
    for limit, ends in ((0.19, True), (0.21, False)):
        for term in (
            mdp.bad_anchor_pos_z_only(env, "motion", limit),
            mdp.bad_motion_body_pos(env, "motion", limit),
            mdp.bad_motion_body_pos_z_only(env, "motion", limit, HANDS),
        ):
            assert term.tolist() == [ends, ends]


def test_a_tilt_is_bad_by_the_change_of_gravity_along_the_anchors_axis(env, place):
    place(turn=(math.pi / 3, 0.0, 0.0))
    command = command_of(env)
    up = [
        matrix_from_quat(q)[:, 2, 2] for q in (command.anchor_quat_w, command.robot_anchor_quat_w)
    ]
    change = (up[0] - up[1]).abs().max().item()
    assert 0.3 < change < 0.7
    robot = SimpleNamespace(name="robot")
    assert mdp.bad_anchor_ori(env, robot, "motion", change - 0.01).all()
    assert not mdp.bad_anchor_ori(env, robot, "motion", change + 0.01).any()


def test_velocities_are_compared_in_world_axes(env, place):
    place(velocity=(0.0, 1.0, 0.0, 0.0, 0.0, 0.0))
    reward = mdp.motion_global_body_linear_velocity_error_exp(env, "motion", 1.0)
    assert value(reward) == pytest.approx(math.exp(-1.0), abs=1e-3)
    place(velocity=(0.0, 0.0, 0.0, 0.0, 0.0, 3.14))
    reward = mdp.motion_global_body_angular_velocity_error_exp(env, "motion", 3.14)
    assert value(reward) == pytest.approx(math.exp(-1.0), abs=1e-3)


def test_terms_look_at_some_bodies_only_if_asked_to(env, place):
    command = place()
    command.body_pos_relative_w[:, command.body_names.index(HANDS[1]), 0] += 0.6
    everywhere = mdp.motion_relative_body_position_error_exp(env, "motion", 0.3)
    assert value(everywhere) == pytest.approx(math.exp(-0.36 / 14 / 0.09), abs=1e-4)
    hands = mdp.motion_relative_body_position_error_exp(env, "motion", 0.3, HANDS)
    assert value(hands) == pytest.approx(math.exp(-0.36 / 2 / 0.09), abs=1e-4)
    feet = ("left_ankle_roll_link", "right_ankle_roll_link")
    others = mdp.motion_relative_body_position_error_exp(env, "motion", 0.3, feet)
    assert value(others) == pytest.approx(1.0, abs=1e-4)
    assert mdp.bad_motion_body_pos(env, "motion", 0.5, HANDS).all()
    assert not mdp.bad_motion_body_pos(env, "motion", 0.5, feet).any()
    assert not mdp.bad_motion_body_pos_z_only(env, "motion", 0.5, HANDS).any()


def test_the_anchor_of_the_reference_is_seen_from_that_of_the_robot(env, place):
    place(shift=(0.0, 0.5, 0.0), turn=(0.0, 0.0, math.pi / 2))
    command = command_of(env)
    seen = mdp.motion_anchor_pos_b(env, "motion")
    rotation = matrix_from_quat(command.robot_anchor_quat_w)
    away = (command.anchor_pos_w - command.robot_anchor_pos_w)[..., None]
    torch.testing.assert_close(seen, (rotation.mT @ away)[..., 0])
    assert seen[0, 0].item() == pytest.approx(-0.5, abs=0.05)
    columns = mdp.motion_anchor_ori_b(env, "motion")
    relative = rotation.mT @ matrix_from_quat(command.anchor_quat_w)
    # Row by row, the first two columns.
    expected = [relative[0, i, j] for i in range(3) for j in range(2)]
    torch.testing.assert_close(columns[0], torch.stack(expected), atol=1e-5, rtol=0)


def test_bodies_are_seen_from_the_anchor_one_after_the_other(env, place):
    command = place(turn=(0.2, -0.1, 0.7))
    pos, ori = mdp.robot_body_pos_b(env, "motion"), mdp.robot_body_ori_b(env, "motion")
    assert (pos.shape, ori.shape) == ((2, 42), (2, 84))
    body = command.body_names.index("left_knee_link")
    rotation = matrix_from_quat(command.robot_anchor_quat_w)[0]
    away = command.robot_body_pos_w[0, body] - command.robot_anchor_pos_w[0]
    torch.testing.assert_close(pos[0, 3 * body : 3 * body + 3], rotation.T @ away)
    relative = rotation.T @ matrix_from_quat(command.robot_body_quat_w)[0, body]
    torch.testing.assert_close(
        ori[0, 6 * body : 6 * body + 6], relative[:, :2].flatten(), atol=1e-5, rtol=0
    )
    # The anchor sees itself at its own origin.
    at = 3 * command.anchor_index
    assert pos[:, at : at + 3].abs().max() < 1e-6


def test_errors_of_evaluations_are_those_of_the_formulas(env, place):
    place(shift=(0.3, 0.0, 0.0), velocity=(0.0,) * 6)
    command = command_of(env)
    command.robot.data.write_joint_velocity(command.joint_vel + 0.5)
    env.sim.forward()
    assert value(mdp.compute_mpkpe(command)) == pytest.approx(0.3, abs=1e-4)
    assert value(mdp.compute_root_relative_mpkpe(command)) == pytest.approx(0.0, abs=1e-4)
    assert value(mdp.compute_joint_velocity_error(command)) == pytest.approx(0.5, abs=1e-4)
    place(shift=(0.0, 0.0, 0.1))
    assert value(mdp.compute_ee_position_error(command, HANDS)) == pytest.approx(0.1, abs=1e-4)
    assert value(mdp.compute_ee_orientation_error(command, HANDS)) == pytest.approx(0.0, abs=1e-3)
    place(turn=(0.3, 0.0, 0.0))
    assert value(mdp.compute_ee_orientation_error(command, HANDS)) == pytest.approx(0.3, abs=1e-2)


def test_no_end_effectors_have_no_error_and_unknown_ones_are_refused(env):
    command = command_of(env)
    assert mdp.compute_ee_position_error(command, ()).tolist() == [0.0, 0.0]
    assert mdp.compute_ee_orientation_error(command, ()).tolist() == [0.0, 0.0]
    for measure in (mdp.compute_ee_position_error, mdp.compute_ee_orientation_error):
        with pytest.raises(ValueError, match="Unknown tracked body 'tail'"):
            measure(command, ("tail",))


@pytest.mark.parametrize("names", [("pelvis", "tail"), ()])
def test_bodies_that_are_not_tracked_warn(env, place, names):
    place()
    with pytest.warns(UserWarning, match="body_names: expected tracked bodies"):
        mdp.motion_relative_body_position_error_exp(env, "motion", 0.3, names)
