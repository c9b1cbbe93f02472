"""Flags of `train` that would be ignored, or train nothing: one line, and nothing is built."""

from __future__ import annotations

import dataclasses
from unittest.mock import Mock

import pytest
from commands import SMALL, TASK

from mjlab.cli.train_config import parse_train_flags, report_moved_goal
from mjlab.rl.config import RslRlPpoAlgorithmCfg
from mjlab.scripts.train import TrainConfig, launch_training
from mjlab.tasks import registry


@pytest.fixture
def no_gpu(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--gpu-ids", "[0]", "--device", "cpu"], "--device cpu"),
        (["--gpu-ids", "[0]"], "expected a visible GPU"),
    ],
)
@pytest.mark.usefixtures("no_gpu")
def test_a_typed_flag_that_would_be_ignored_ends_with_status_2(run, tmp_path, flags, named):
    outcome = run("train", TASK, "--log-root", str(tmp_path / "logs"), *flags)
    assert outcome.status == 2
    assert named in outcome.message
    assert flags[0].partition("=")[0].replace("_", "-") in outcome.message
    assert not (tmp_path / "logs").exists()


def test_flags_without_effect_train_with_a_notice(run, tmp_path):
    flags = {
        "--agent.class_name": "Foo",
        "--wandb-run-path": "me/project/abc",
        "--agent.load-run": "2026.*",
        "--agent.load-checkpoint": "model_1.pt",
        "--video-length": "0",
    }
    argv = ["--log-root", str(tmp_path), "--agent.max-iterations", "1"]
    outcome = run("train", TASK, *SMALL, *argv, *(word for pair in flags.items() for word in pair))
    assert outcome.status == 0, outcome.err
    for flag in [*flags][:4]:
        assert outcome.err.count(flag.replace("_", "-")) == 1
    assert len(list(tmp_path.glob("cartpole/*/model_0.pt"))) == 1


def test_no_iterations_train_nothing(run, tmp_path):
    argv = ["--log-root", str(tmp_path), "--agent.max-iterations", "0"]
    outcome = run("train", TASK, *SMALL, *argv)
    assert outcome.status == 0, outcome.err
    assert not list(tmp_path.glob("cartpole/*/model_*.pt"))


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--env.rewards.smooth-reward.weight", "9"], "rewards.smooth_reward.weight"),
        (["--env.rewards.smooth-reward", "None"], "rewards.smooth_reward"),
        (["--env.decimation", "2"], "decimation"),
    ],
)
def test_weights_are_named_beside_the_goal(capsys, flags, named):
    report_moved_goal(TASK, parse_train_flags(TASK, flags, "train"))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (named is not None)
    assert all("goal of return 900" in line and str(named) in line for line in lines)


def test_goals_in_metrics_do_not_move(capsys):
    flags = ["--profile", "cpu", "--env.rewards.action-rate-l2.weight", "-9"]
    task = "Mjlab-Velocity-Flat-Unitree-Go1"
    report_moved_goal(task, parse_train_flags(task, flags, "train"))
    assert not capsys.readouterr().err


def test_train_reports_a_moved_goal_once(run, tmp_path):
    argv = ["--log-root", str(tmp_path), "--agent.max-iterations", "1"]
    outcome = run("train", TASK, *SMALL, *argv, "--env.rewards.smooth-reward.weight", "9")
    assert outcome.status == 0, outcome.err
    assert outcome.err.count("goal of return 900") == 1


@pytest.mark.parametrize("flag", ["--agent.seed", "--agent.run-name"])
def test_train_seeds_refuses_what_it_sets_itself(run, flag):
    outcome = run("train_seeds", TASK, "--seeds", "1", flag, "3")
    assert outcome.status == 2
    assert flag in outcome.message


@pytest.mark.usefixtures("no_gpu")
def test_defaults_that_have_no_effect_are_silent(run, tmp_path):
    flags = ("--log-root", str(tmp_path), "--agent.max-iterations", "1")
    outcome = run("train", TASK, *SMALL, *flags, "--agent.class-name", "OnPolicyRunner")
    assert outcome.status == 0
    assert "gpu-ids" not in outcome.err


@pytest.mark.parametrize(
    ("flag", "value", "expected"),
    [
        ("--agent.algorithm.gamma", "nan", "a number in [0, 1]"),
        ("--agent.max-iterations", "-1", "an integer >= 0"),
        ("--env.sim.mujoco.iterations", "3000000000", "an integer in [0, 2147483647]"),
    ],
)
def test_typed_numbers_out_of_range_raise(run, tmp_path, flag, value, expected):
    outcome = run("train", TASK, *SMALL, "--log-root", str(tmp_path / "logs"), flag, value)
    assert outcome.status == 1
    assert f"{flag.replace('_', '-')}: expected {expected}, got" in outcome.message
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("flags", "status"),
    [([], 0), (["--agent.algorithm.gamma", "0.9"], 0), (["--agent.algorithm.gamma=1.5"], 1)],
)
def test_numbers_of_a_task_out_of_range_warn(run, tmp_path, monkeypatch, flags, status):
    cfg = registry.load_rl_cfg(TASK)
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    cfg.algorithm = _Undiscounted(num_mini_batches=1)
    registry.register_mjlab_task("Test-Ranges", registry.load_env_cfg(TASK), rl_cfg=cfg)
    small = (*SMALL, "--agent.max-iterations", "1", "--log-root", str(tmp_path))
    outcome = run("train", "Test-Ranges", *small, *flags)
    assert outcome.status == status
    told = "agent.algorithm.gamma: expected a number in [0, 1], got 1.5"
    assert outcome.err.count(told) == (flags == []) + status


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("../out", 1),
        ("group/own", 0),
    ],
)
def test_an_experiment_outside_of_the_root_is_told(run, tmp_path, name, told):
    root = tmp_path / "logs"
    root.mkdir()
    (root / "linked").symlink_to(tmp_path)
    flags = ("--agent.max-iterations", "1", "--log-root", str(root))
    outcome = run("train", TASK, *SMALL, *flags, "--agent.experiment-name", name)
    assert outcome.status == 0
    assert (outcome.out + outcome.err).count(
        "--agent.experiment-name: expected a folder in"
    ) == told


def test_numbers_of_a_program_out_of_range_warn(tmp_path):
    cfg = TrainConfig.from_task(TASK)
    cfg.device, cfg.num_envs, cfg.log_root = "cpu", 4, str(tmp_path)
    cfg.agent.max_iterations, cfg.agent.num_steps_per_env = 1, 4
    cfg.agent.algorithm.lam = 3.0
    with pytest.warns(UserWarning, match=r"agent\.algorithm\.lam: expected a number in \[0, 1\]"):
        launch_training(TASK, cfg)


def test_zero_of_a_count_raises_also_in_a_task(run, tmp_path, monkeypatch):
    cfg = registry.load_rl_cfg(TASK)
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    cfg.save_interval = 0
    registry.register_mjlab_task("Test-Ranges", registry.load_env_cfg(TASK), rl_cfg=cfg)
    outcome = run("train", "Test-Ranges", "--device", "cpu", "--log-root", str(tmp_path / "logs"))
    assert outcome.status == 1
    assert "agent.save_interval: expected an integer >= 1, got 0" in outcome.message
    assert not (tmp_path / "logs").exists()


@dataclasses.dataclass
class _Undiscounted(RslRlPpoAlgorithmCfg):
    gamma: float = 1.5


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("can't start new thread")])
def test_too_little_memory_is_one_message(run, tmp_path, monkeypatch, error):
    monkeypatch.setattr("mjlab.scripts.train.training_env", Mock(side_effect=error))
    outcome = run("train", TASK, *SMALL, "--log-root", str(tmp_path))
    assert outcome.status == 1
    assert "memory" in outcome.message
    assert "Traceback" not in outcome.err


def test_a_run_that_ends_before_it_learns_is_refused(run, tmp_path):
    flags = ("--log-root", str(tmp_path), "--learner", "sac", "--agent.max-iterations", "1")
    outcome = run("train", TASK, *SMALL, *flags, "--agent.algorithm.learning-starts", "9")
    assert outcome.status == 1
    assert "learning-starts: expected at most 8" in outcome.message


@pytest.mark.parametrize(("learner", "is_told"), [("sac", True), ("ppo", False)])
def test_a_profile_for_another_learner_is_told(run, tmp_path, monkeypatch, learner, is_told):
    cfg = registry.load_env_cfg(TASK)
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    registry.register_mjlab_task(
        "Test-Profiled",
        cfg,
        rl_cfg=registry.load_rl_cfg(TASK),
        profiles={"small": lambda env_cfg, rl_cfg: None},
    )
    flags = ("--log-root", str(tmp_path), "--profile", "small", "--learner", learner)
    small = (*SMALL, "--agent.max-iterations", "2")
    outcome = run("train", "Test-Profiled", *small, *flags)
    assert outcome.status == 0, outcome.err
    assert ("settings for the learner 'ppo'" in outcome.err) == is_told


def test_a_message_of_a_damaged_file_is_cut_in_the_middle(run, monkeypatch):
    def build(*args, **kwargs):
        raise ValueError("begins " + "x" * 100_000 + " ends")

    monkeypatch.setattr("mjlab.scripts.train.train_until_stopped", build)
    outcome = run("train", TASK, *SMALL)
    assert outcome.status == 1
    assert len(outcome.err) < 10_000
    assert "begins" in outcome.message
    assert "ends" in outcome.message
