"""Manipulation runner: exported policies and success."""

from __future__ import annotations

from dataclasses import asdict

import onnx
import pytest
import torch
from lifting_tasks import DEPTH, LIFT, MULTI, RGB, lifting, task_cfg

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.rl.evaluation import evaluate_policy
from mjlab.tasks.manipulation.config.yam.rl_cfg import PLACEMENT, placed_at_goal
from mjlab.tasks.manipulation.rl import ManipulationOnPolicyRunner
from mjlab.tasks.registry import load_rl_cfg, load_runner_cls
from mjlab.utils.random import seed_rng


def make_runner(task: str, log_dir) -> ManipulationOnPolicyRunner:
    """Return a runner of a small policy in small environments."""
    seed_rng(1)
    env = ManagerBasedRlEnv(task_cfg(task, num_envs=4), device="cpu")
    cfg = asdict(load_rl_cfg(task))
    cfg["num_steps_per_env"], cfg["save_interval"] = 4, 100
    for model in ("actor", "critic"):
        cfg[model]["hidden_dims"] = (16,)
    folder = None if log_dir is None else str(log_dir)
    return ManipulationOnPolicyRunner(RslRlVecEnvWrapper(env), cfg, folder, "cpu")


def weights(runner: ManipulationOnPolicyRunner) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in runner.alg.get_policy().parameters()])


def test_the_tasks_are_trained_by_their_runner():
    for task in (LIFT, RGB, DEPTH, MULTI):
        assert load_runner_cls(task) is ManipulationOnPolicyRunner


def test_saving_writes_the_policy_beside_the_checkpoint(tmp_path):
    folder = tmp_path / "2026-01-02_lift"
    runner = make_runner(LIFT, None)
    runner.save(str(folder / "model_7.pt"))
    runner.env.unwrapped.close()
    assert sorted(p.name for p in folder.iterdir()) == ["2026-01-02_lift.onnx", "model_7.pt"]
    model = onnx.load(folder / "2026-01-02_lift.onnx")
    batch, size = model.graph.input[0].type.tensor_type.shape.dim
    assert (batch.dim_value, size.dim_value) == (1, 29)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["command_names"] == "lift_height"
    names = metadata["observation_names"].split(",")
    assert names == ["joint_pos", "joint_vel", "ee_to_cube", "cube_to_goal", "actions"]
    scales = [float(scale) for scale in metadata["action_scale"].split(",")]
    assert scales[5:7] == pytest.approx([5.520026131, 0.08657395591], rel=1e-6)


@pytest.mark.parametrize(
    "task",
    [
        LIFT,
        pytest.param(MULTI, marks=pytest.mark.slow),
    ],
)
def test_training_learns_and_resumes_exactly(task, tmp_path):
    whole = make_runner(task, tmp_path / "whole")
    before = weights(whole)
    whole.learn(2, init_at_random_ep_len=True)
    assert not torch.equal(weights(whole), before)
    first = make_runner(task, tmp_path / "first")
    first.learn(1, init_at_random_ep_len=True)
    resumed = make_runner(task, None)
    resumed.load(str(tmp_path / "first" / "model_0.pt"))
    resumed.learn(2)
    assert torch.equal(weights(resumed), weights(whole))
    for runner in (whole, first, resumed):
        runner.env.unwrapped.close()


# Scoring.


def still(observations) -> torch.Tensor:
    return torch.zeros(observations["actor"].shape[0], 7)


@pytest.mark.parametrize("met", [True, False])
def test_evaluations_report_success_errors_and_the_time_at_the_goal(make_env, met):
    def edit(cfg):
        cfg.episode_length_s = 1.0
        command = cfg.commands["lift_height"]
        # The goal is where the cube lies, or above it.
        command.object_pose_range.x = command.object_pose_range.y = (0.3, 0.3)
        command.target_position_range.x = command.target_position_range.y = (0.3, 0.3)
        command.target_position_range.z = (0.02, 0.02) if met else (0.3, 0.3)

    env = RslRlVecEnvWrapper(make_env(edit=edit, num_envs=6))
    evaluation = load_rl_cfg(LIFT).evaluation
    assert evaluation.criterion is placed_at_goal
    assert evaluation.metrics == PLACEMENT
    result = evaluate_policy(
        env, still, 6, success=evaluation.criterion, metrics=evaluation.metrics, seed=0
    )
    assert result.success_rate == float(met)
    low, high = result.success_interval
    # Of six episodes that all end alike, not more is known than that.
    assert (low, high) == pytest.approx((0.61, 1.0) if met else (0.0, 0.39), abs=0.01)
    assert result.metrics["at_goal"].mean == pytest.approx(float(met), abs=0.03)
    assert result.metrics["position_error"].mean == pytest.approx(0.0 if met else 0.28, abs=0.02)
    assert result.mean_length == 50


def test_a_goal_that_comes_just_before_the_end_costs_no_success(make_env):
    # Goals are at the start of the untouched cube. All goals are met except the last one,
    # sampled two steps before the end and out of reach.
    def edit(cfg):
        cfg.episode_length_s = 1.0
        command = cfg.commands["lift_height"]
        command.difficulty = "fixed"
        command.resampling_time_range = (0.94, 0.94)
        command.object_pose_range = None

    wrapped = RslRlVecEnvWrapper(make_env(edit=edit, num_envs=3))
    env = wrapped.unwrapped
    cube = env.scene["cube"]

    def put_at_goal(_observations) -> torch.Tensor:
        term = lifting(env)
        pose = torch.zeros(3, 7)
        pose[:, 3] = 1.0
        pose[:, :3] = term.target_pos
        if bool((term.command_counter > 1).any()):
            pose[:, 2] += 0.2
        cube.write_root_link_pose_to_sim(pose)
        cube.write_root_link_velocity_to_sim(torch.zeros(3, 6))
        return torch.zeros(3, 7)

    result = evaluate_policy(wrapped, put_at_goal, 3, success=placed_at_goal, seed=0)
    assert result.success_rate == 1.0
    literal = evaluate_policy(
        wrapped, put_at_goal, 3, success=lambda e: lifting(e).compute_success(), seed=0
    )
    assert literal.success_rate == 0.0


def test_an_episode_that_is_cut_short_is_judged_by_the_goal_of_then(make_env):
    env = make_env(num_envs=2)
    env.reset()
    term = lifting(env)
    # Both met a goal, and have had another for a moment.
    term.command_counter[:] = 2
    term.last_goal_met[:], term.goal_age[:] = True, 0.0
    term.metrics["position_error"][:] = 1.0
    env.episode_length_buf[:] = torch.tensor([env.max_episode_length - 1, 500])
    assert placed_at_goal(env).tolist() == [True, False]
    term.metrics["position_error"][1] = 0.0
    assert placed_at_goal(env).tolist() == [True, True]
