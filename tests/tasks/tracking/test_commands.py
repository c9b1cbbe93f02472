"""Motion command: order of a step, starts, the end of a motion, and config errors."""

from __future__ import annotations

import re
from functools import partial

import pytest
import torch
from tracking_tasks import G1, G1_BLIND, part_of, task_cfg, unperturbed

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.tracking.mdp import motion_sampling as start_module
from mjlab.tasks.tracking.mdp.motion_library import MotionFrame
from mjlab.utils.lab_api.math import quat_from_euler_xyz, quat_mul


def command_of(env):
    return env.command_manager.get_term("motion")


def idle(env):
    return env.step(torch.zeros(env.num_envs, env.action_manager.total_action_dim))


def robot_is_at(env, frames: torch.Tensor) -> bool:
    """Return True if the robots match the frames exactly, indexed over all motions."""
    command = command_of(env)
    there = MotionFrame(command, frames)
    joints = (command.robot_joint_pos - there.joint_pos).abs().max()
    bodies = (command.robot_body_pos_w - there.body_pos_w).abs().max()
    return bool(joints < 1e-5) and bool(bodies < 1e-4)


def without_end(cfg):
    unperturbed(cfg)
    # Nothing ends an episode but its length.
    cfg.terminations = {"time_out": cfg.terminations["time_out"]}


@pytest.fixture
def short(tmp_path):
    """Motion of 0.1 s from the middle of the walk."""
    return part_of("slow_walk", slice(100, 105), tmp_path / "short.npz")


@pytest.mark.parametrize(("task", "size"), [(G1, 160), (G1_BLIND, 154)])
def test_observations_have_the_sizes_of_the_interface(make_env, task, size):
    env = make_env(task=task, num_envs=2)
    assert env.observation_manager.group_obs_dim == {"actor": (size,), "critic": (286,)}


def test_resets_put_robots_at_a_frame(make_env):
    env = make_env(edit=unperturbed, sampling_mode="uniform", num_envs=6)
    env.reset()
    command = command_of(env)
    assert command.time_steps.unique().numel() > 3
    assert (command.time_steps >= 1).all()
    assert robot_is_at(env, command.frame_indexes - 1)
    assert not robot_is_at(env, command.frame_indexes)
    # The frame that matches the robot, for evaluations.
    assert torch.equal(command.matching_frame.frame_indexes, command.frame_indexes - 1)
    for name in (
        "error_anchor_pos", "error_anchor_rot", "error_joint_pos", "error_body_lin_vel",
        "error_body_pos", "error_body_rot",
    ):  # fmt: skip
        assert command.metrics[name].max() < 2e-3, name


def test_places_of_the_reference_are_those_of_each_environment(make_env):
    env = make_env(edit=unperturbed, sampling_mode="start", motion="wave")
    env.reset()
    command = command_of(env)
    first = command.motion.body_pos_w[1, 0] + env.scene.env_origins
    torch.testing.assert_close(command.body_pos_w[:, 0], first)
    torch.testing.assert_close(command.anchor_pos_w, command.body_pos_w[:, command.anchor_index])
    assert command.body_pos_w[:, 0, :2].unique(dim=0).shape[0] == 4


def test_the_reference_advances_by_a_frame_a_step_and_is_the_command(make_env):
    env = make_env(edit=without_end, sampling_mode="start", motion="wave")
    env.reset()
    command = command_of(env)
    for t in range(2, 6):
        idle(env)
        assert (command.time_steps == t).all()
        wanted = torch.cat((command.motion.joint_pos[t], command.motion.joint_vel[t]))
        assert torch.equal(command.command, wanted.expand(4, -1))


def test_rewards_compare_the_robot_with_the_frame_that_the_policy_saw(make_env, monkeypatch):
    env = make_env(edit=without_end, sampling_mode="start", motion="wave")
    env.reset()
    command, seen = command_of(env), []
    compute = env.reward_manager.compute

    def spy(dt):
        seen.append(command.time_steps.clone())
        return compute(dt=dt)

    monkeypatch.setattr(env.reward_manager, "compute", spy)
    before = command.time_steps.clone()
    idle(env)
    assert torch.equal(seen[0], before)


def test_resetting_some_leaves_the_reference_of_others_alone(make_env):
    env = make_env(edit=without_end, sampling_mode="start", motion="wave")
    env.reset()
    idle(env)
    env.reset(env_ids=torch.tensor([1, 3]))
    assert command_of(env).time_steps.tolist() == [2, 1, 2, 1]


# Starts.


def test_starts_are_perturbed_by_the_formula(make_env, monkeypatch):
    env = make_env(
        motion="wave", sampling_mode="start", num_envs=2,
        pose_range={"x": (0.1, 0.1), "z": (0.02, 0.02), "roll": (0.3, 0.3), "yaw": (0.5, 0.5)},
        velocity_range={"y": (0.4, 0.4), "pitch": (-0.2, -0.2)},
        joint_position_range=(0.05, 0.05),
    )  # fmt: skip
    env.event_manager.reset()
    command = command_of(env)
    command.reset(None)
    env.sim.forward()
    data, motion = command.robot.data, command.motion
    shift = torch.tensor([0.1, 0.0, 0.02]) + env.scene.env_origins
    torch.testing.assert_close(data.root_link_pos_w, motion.body_pos_w[0, 0] + shift)
    turn = quat_from_euler_xyz(*torch.tensor([0.3, 0.0, 0.5]))
    expected = quat_mul(turn, motion.body_quat_w[0, 0])
    torch.testing.assert_close(data.root_link_quat_w, expected.expand(2, 4), atol=1e-6, rtol=0)
    lin = motion.body_lin_vel_w[0, 0] + torch.tensor([0.0, 0.4, 0.0])
    ang = motion.body_ang_vel_w[0, 0] + torch.tensor([0.0, -0.2, 0.0])
    torch.testing.assert_close(data.root_link_lin_vel_w, lin.expand(2, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(data.root_link_ang_vel_w, ang.expand(2, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(data.joint_pos[0], motion.joint_pos[0] + 0.05)
    torch.testing.assert_close(data.joint_vel[0], motion.joint_vel[0])


def test_pose_velocity_and_joints_are_drawn_in_this_order(make_env, monkeypatch):
    shapes = []

    def spy(draw, *args):
        drawn = draw(*args)
        shapes.append(tuple(drawn.shape))
        return drawn

    for name in ("sample_ranges", "sample_uniform"):
        monkeypatch.setattr(start_module, name, partial(spy, getattr(start_module, name)))
    make_env(motion="wave", num_envs=3).reset()
    assert shapes == [(3, 6), (3, 6), (3, 29)]


def test_joints_start_within_their_soft_limits(make_env):
    env = make_env(motion="wave", joint_position_range=(9.0, 9.0), num_envs=2)
    env.reset()
    data = command_of(env).robot.data
    torch.testing.assert_close(data.joint_pos, data.soft_joint_pos_limits[..., 1])


def test_playing_starts_exactly_at_the_first_frame(make_env):
    env = make_env(play=True, num_envs=3)
    env.reset()
    command = command_of(env)
    assert (command.time_steps == 1).all()
    assert robot_is_at(env, command.frame_indexes - 1)


def test_a_start_forgets_targets_and_holds_the_joints_where_they_are(make_env):
    env = make_env(motion="wave", num_envs=2)
    env.reset()
    data = command_of(env).robot.data
    data.joint_pos_target[:] = 7.0
    command_of(env).reset_to_frame(torch.tensor([0]), 40)
    torch.testing.assert_close(data.joint_pos_target[0], data.joint_pos[0])
    assert (data.joint_pos_target[1] == 7.0).all()


def test_several_motions_are_played_one_after_the_other_from_the_start(make_env):
    env = make_env(edit=unperturbed, sampling_mode="start", motion="squat,wave,slow_walk")
    env.reset()
    command = command_of(env)
    assert command.motion.names == ("squat", "wave", "slow_walk")
    assert command.motion_ids.tolist() == [0, 1, 2, 0]
    assert robot_is_at(env, command.motion.starts[command.motion_ids])
    env.reset()
    assert command.motion_ids.tolist() == [1, 2, 0, 1]
    lengths = command.motion.lengths
    assert command.motion.time_step_total == int(lengths.sum()) == len(command.motion.joint_pos)


def test_adaptive_sampling_draws_from_all_motions(make_env):
    env = make_env(motion="squat,wave", num_envs=64)
    env.reset()
    command = command_of(env)
    assert set(command.motion_ids.tolist()) == {0, 1}
    assert (command.time_steps <= command.motion.lengths[command.motion_ids] - 1).all()
    assert (command.metrics["sampling_entropy"] > 0.999).all()


def test_uniform_sampling_reports_itself(make_env):
    env = make_env(motion="squat", sampling_mode="uniform")
    env.reset()
    metrics = command_of(env).metrics
    # 221 frames of 0.02 s: five bins.
    assert metrics["sampling_top1_prob"].tolist() == pytest.approx([0.2] * 4)
    assert (metrics["sampling_entropy"] == 1.0).all()
    assert (metrics["sampling_top1_bin"] == 0.5).all()


def test_reset_to_frame_is_exact_and_stays_within_the_motion(make_env):
    env = make_env(motion="squat,wave")
    env.reset()
    command = command_of(env)
    for frame, reached in ((30, 30), (-5, 0), (10_000, None)):
        ids = torch.arange(4)
        command.reset_to_frame(ids, frame)
        env.sim.forward()
        last = command.motion.lengths[command.motion_ids] - 1
        expected = last if reached is None else torch.full_like(last, reached)
        assert torch.equal(command.time_steps, expected)
        assert robot_is_at(env, command.frame_indexes)


# The end of a motion.


def test_the_end_of_a_motion_is_a_time_out_and_starts_anew(make_env, short):
    env = make_env(edit=unperturbed, motion=short, sampling_mode="start")
    env.cfg.terminations["ee_body_pos"] = None
    env.reset()
    command = command_of(env)
    ends = []
    for _ in range(4):
        terminated, truncated = idle(env)[2:4]
        assert not terminated.any()
        ends.append(truncated.all().item())
    # Five frames: the reference is at 1 to 4, and with 4 it has ended.
    assert ends == [False, False, False, True]
    assert (env.episode_length_buf == 0).all()
    assert (command.time_steps == 1).all()
    assert robot_is_at(env, command.frame_indexes - 1)


@pytest.mark.parametrize(("advances", "ahead"), [(True, 1), (False, 0)])
def test_without_that_term_the_robot_is_teleported_within_its_episode(
    make_env, short, advances, ahead
):
    env = make_env(
        edit=without_end, motion=short, sampling_mode="start", advance_after_teleport=advances
    )
    env.reset()
    command = command_of(env)
    for _ in range(4):
        done = idle(env)[2:4]
        assert not torch.stack(done).any()
    assert (env.episode_length_buf == 4).all()
    assert (command.time_steps == ahead).all()
    # The step's own forward came before.
    assert robot_is_at(env, torch.zeros(4, dtype=torch.long))
    pos, quat = command.relative_poses()
    torch.testing.assert_close(command.body_pos_relative_w, pos)
    torch.testing.assert_close(command.body_quat_relative_w, quat)


def test_only_robots_that_were_teleported_are_computed_anew(make_env, short, monkeypatch):
    env = make_env(edit=without_end, motion=f"wave,{short}", sampling_mode="start")
    env.reset()
    calls = []
    forward = env.sim.forward

    def count(ids=None, stage="acc"):
        calls.append(ids)
        forward(ids, stage)

    monkeypatch.setattr(env.sim, "forward", count)
    for _ in range(4):
        idle(env)
    some = [ids.tolist() for ids in calls if ids is not None]
    assert some == [[1, 3]]


# Relative poses.


def displaced(env, shift, yaw) -> None:
    """Move and rotate all robots, and nothing else."""
    data = command_of(env).robot.data
    pos = data.root_link_pos_w + torch.tensor(shift)
    turn = quat_from_euler_xyz(*torch.tensor([0.0, 0.0, yaw])).expand(env.num_envs, 4)
    quat = quat_mul(turn, data.root_link_quat_w)
    data.write_root_pose(torch.cat((pos, quat), dim=1))
    env.sim.forward()


def test_relative_references_follow_the_robot(make_env):
    env = make_env(motion="slow_walk", num_envs=2)
    env.reset()
    command = command_of(env)
    command.reset_to_frame(torch.arange(2), 150)
    env.sim.forward()
    displaced(env, [0.7, -0.4, 0.0], 1.1)
    pos, quat = command.relative_poses()
    assert (pos - command.robot_body_pos_w).abs().max() < 1e-4
    assert (pos - command.body_pos_w).abs().max() > 0.3
    inner = (quat * command.robot_body_quat_w).sum(dim=-1).abs()
    assert (1.0 - inner).max() < 1e-5


def test_the_relative_reference_keeps_its_own_height(make_env):
    env = make_env(motion="slow_walk", num_envs=2)
    env.reset()
    command = command_of(env)
    command.reset_to_frame(torch.arange(2), 150)
    env.sim.forward()
    displaced(env, [0.0, 0.0, 0.2], 0.0)
    pos, _ = command.relative_poses()
    torch.testing.assert_close(pos[..., 2], command.body_pos_w[..., 2], atol=1e-5, rtol=0)


def test_relative_poses_are_those_of_now_after_a_reset(make_env):
    env = make_env()
    env.reset()
    for step in range(3):
        if step:
            env.reset(env_ids=torch.tensor([2]))
        command = command_of(env)
        pos, quat = command.relative_poses()
        torch.testing.assert_close(command.body_pos_relative_w, pos)
        torch.testing.assert_close(command.body_quat_relative_w, quat)
        idle(env)


def test_errors_after_a_reset_in_a_step_are_not_of_the_pose_before_it(make_env):
    env = make_env(edit=unperturbed, sampling_mode="start", motion="slow_walk", num_envs=2)
    env.reset()
    command = command_of(env)
    for _ in range(3):
        idle(env)
    kept = command.metrics["error_body_pos"][1].clone()
    # Halfway through the walk, a step away from its start.
    command.reset_to_frame(torch.tensor([0]), 200)
    env.sim.forward()
    command.update_relative_body_poses()
    displaced(env, [0.0, 0.0, 1.0], 0.0)
    assert idle(env)[2].all()
    assert command.metrics["error_body_pos"].max() < 2e-3
    assert command.metrics["error_body_rot"].max() < 5e-3
    assert kept > 0.0


# Failures.


def failing(env, ids, frame=60):
    """End a step with failures of some environments at a frame of the motion."""
    command = command_of(env)
    command.time_steps[:] = frame
    env.termination_manager.terminated[:] = False
    env.termination_manager.terminated[ids] = True
    env.common_step_counter += 1


def test_a_failure_is_counted_once_at_the_frame_where_it_happened(make_env):
    env = make_env(motion="squat")
    env.reset()
    command = command_of(env)
    failing(env, [0, 2])
    command.reset(torch.tensor([0, 2]))
    # Frame 60 of 221 is in bin 1 of 5.
    assert command.sampler.current_failed.tolist() == [0, 2, 0, 0, 0]
    # Flags stay set until the next step, but an explicit reset does not count as another failure.
    before = command.sampler.current_failed.clone()
    command.sampler.end_step()
    command.reset(torch.tensor([0, 1, 2]))
    assert command.sampler.current_failed.sum() == 0
    assert before.sum() == 2


def test_time_outs_are_no_failures(make_env):
    env = make_env(motion="squat")
    env.reset()
    failing(env, [])
    env.termination_manager.time_outs[:] = True
    command_of(env).reset(None)
    assert command_of(env).sampler.current_failed.sum() == 0


def test_failures_of_a_real_step_reach_the_statistics(make_env):
    env = make_env(motion="wave")
    env.reset()
    command = command_of(env)
    # The robots are lifted off the reference, which ends their episodes.
    displaced(env, [0.0, 0.0, 1.0], 0.0)
    terminated = idle(env)[2]
    assert terminated.all()
    assert command.sampler.failed.sum() == pytest.approx(4 * 0.001)


def test_episodes_start_where_they_fail(make_env):
    env = make_env(motion="squat", num_envs=64)
    env.reset()
    command = command_of(env)
    command.sampler.failed[3] = 50.0
    command.reset(None)
    # Bin 3 of 5, of frames 0 to 220.
    assert command.time_steps.min() >= 132
    assert command.time_steps.max() < 176
    assert (command.metrics["sampling_top1_prob"] > 0.99).all()
    assert command.metrics["sampling_top1_bin"].tolist() == pytest.approx([0.6] * 64)


# Resume.


@pytest.mark.parametrize("lengths", [(221, 205), (40, 205, 221)])
def test_the_state_of_a_run_on_motions_of_other_lengths_is_refused(make_env, tmp_path, lengths):
    """Frames may not exist here. Both have equal numbers of segments, or no statistics."""

    def env_of(*counts):
        files = [part_of("wave", slice(0, n), tmp_path / f"{n}.npz") for n in counts]
        return make_env(motion=",".join(map(str, files)), sampling_mode="uniform", num_envs=2)

    one, other = env_of(*lengths), env_of(*lengths[::-1])
    one.reset()
    other.reset()
    with pytest.raises(ValueError, match="task differs: .*_extent"):
        other.load_state_dict(one.state_dict())
    one.load_state_dict(one.state_dict())


# Config errors.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motion_file": ""}, "motion_file: expected a motion"),
        ({"motion_file": "nothing.npz"}, "motion 'nothing.npz'"),
        ({"anchor_body_name": "head"}, "anchor_body_name: .*'torso_link'.*'head'"),
        ({"body_names": ("pelvis", "torso_link", "tail")}, "'tail'"),
        ({"sampling_mode": "random"}, "sampling_mode.*'random'"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_when_the_task_is_built(changes, message):
    with pytest.raises(ValueError, match=message) as caught:
        ManagerBasedRlEnv(task_cfg(**changes), device="cpu")
    assert "CommandManager term 'motion'" in str(caught.value)


@pytest.mark.parametrize("name", ["dog"])
def test_what_is_no_entity_is_named_with_those_of_the_scene(name):
    with pytest.raises(KeyError, match=f"CommandManager term 'motion': .*'{name}'.*'robot'"):
        ManagerBasedRlEnv(task_cfg(entity_name=name), device="cpu")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pose_range": {"up": (0.0, 1.0)}}, "pose_range.*'up'"),
        ({"velocity_range": {"up": (0.0, 1.0)}}, "velocity_range.*'up'"),
    ],
)  # fmt: skip
def test_odd_settings_are_one_warning(make_env, changes, message):
    with pytest.warns(UserWarning, match="MotionCommandCfg") as warned:
        env = make_env(**changes)
    assert len(warned) == 1
    assert re.search(message, str(warned[0].message))
    env.reset()
    assert env.step(torch.zeros(4, 29))[1].isfinite().all()


def test_episodes_start_from_the_first_tracked_body(make_env):
    tracked = task_cfg().commands["motion"].body_names
    names = ("torso_link", *(name for name in tracked if name != "torso_link"))
    with pytest.warns(UserWarning, match="'pelvis' first, got 'torso_link'"):
        env = make_env(body_names=names, edit=unperturbed, sampling_mode="start")
    env.reset()
    command = command_of(env)
    torso = command.motion.body_pos_w[0, 0] + env.scene.env_origins
    torch.testing.assert_close(command.robot.data.root_link_pos_w, torso)


def test_frames_of_another_rate_are_played_one_per_step(make_env, tmp_path):
    path = part_of("wave", slice(0, 20), tmp_path / "slow.npz", fps=30.0)
    with pytest.warns(UserWarning, match="fps: expected 50,.* got 30"):
        env = make_env(path, sampling_mode="start")
    env.reset()
    before = command_of(env).time_steps.clone()
    env.step(torch.zeros(4, 29))
    assert (command_of(env).time_steps == before + 1).all()


def test_the_config_is_left_as_it_was(make_env):
    cfg = task_cfg()
    before = dict(vars(cfg.commands["motion"]))
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    env.close()
    assert vars(cfg.commands["motion"]) == before


@pytest.mark.parametrize("mode", ["adaptive", "uniform"])
def test_bins_and_anchors_are_told_under_the_names_of_the_interface(make_env, short, mode):
    command = command_of(make_env(short, num_envs=1, sampling_mode=mode))
    assert command.bin_failed_count.shape == (command.bin_count,)
    assert not command.bin_failed_count.any()
    if mode == "adaptive":
        command.sampler.failed[-1] = 0.5
        assert command.bin_failed_count[-1] == 0.5
    name = command.cfg.anchor_body_name
    assert command.cfg.body_names[command.motion_anchor_body_index] == name
    assert command.robot.body_names[command.robot_anchor_body_index] == name
