"""Run logger: tags and values against rsl_rl's logger, and attributes that runner subclasses read."""

from __future__ import annotations

import os
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils.logger import Logger

from mjlab.rl import MjlabOnPolicyRunner
from mjlab.rl.plot import plot_run, read_scalars
from mjlab.rl.run_logger import IterationStats, RunLogger, mean_length

NUM_ENVS, STEPS = 3, 4


class Writer:
    """Writer that keeps scalars by (tag, step)."""

    def __init__(self) -> None:
        self.scalars: dict[tuple[str, int], float] = {}

    def add_scalar(self, tag: str, value: Any, step: int) -> None:
        assert (tag, step) not in self.scalars
        self.scalars[tag, step] = float(value)


def make_logger(kind: type[Logger], rnd: bool) -> Any:
    cfg = {"num_steps_per_env": STEPS, "algorithm": {"rnd_cfg": {"weight": 0.1} if rnd else None}}
    logger = kind(
        log_dir="nowhere", cfg=cfg, env_cfg={}, num_envs=NUM_ENVS, is_distributed=False,
        gpu_world_size=1, gpu_global_rank=0, device="cpu",
    )  # fmt: skip
    logger.writer = Writer()  # ty: ignore
    return logger


def feed(logger: Any, rnd: bool, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for _ in range(STEPS):
        rewards = torch.randn(NUM_ENVS, generator=generator)
        intrinsic = torch.rand(NUM_ENVS, generator=generator) if rnd else None
        # No episode ends in the first iteration.
        dones = (torch.rand(NUM_ENVS, generator=generator) < (0.4 if seed else 0.0)).long()
        log = {"plain": 2.0, "Metrics/a": torch.randn(NUM_ENVS, generator=generator)}
        logger.process_env_step(rewards, dones, {"log": log}, intrinsic)


REPORT = {"learning_rate": 1e-3, "action_std": torch.tensor([0.5, 0.7])}


@pytest.mark.parametrize("rnd", [False, True])
@pytest.mark.parametrize("entry", ["finish_iteration", "log"])
def test_every_tag_of_rsl_rl_is_written_with_its_value_and_step(rnd, entry, capsys):
    theirs, ours = make_logger(Logger, rnd), make_logger(RunLogger, rnd)
    for it in range(3):
        feed(theirs, rnd, it)
        feed(ours, rnd, it)
        report = {**REPORT, "rnd_weight": 0.1 if rnd else None}
        losses, times = {"value": 0.25 * it}, {"collect_time": 0.8, "learn_time": 0.7}
        theirs.log(it=it, start_it=0, total_it=3, loss_dict=losses, **times, **report)
        if entry == "log":
            ours.log(it=it, start_it=0, total_it=3, loss_dict=losses, **times, **report)
            continue
        ours.finish_iteration(
            iteration=it, first_iteration=0, total_iterations=3, losses=losses,
            collection_time=0.8, learning_time=0.7, exploring={}, **report,
        )  # fmt: skip
    expected, written = theirs.writer.scalars, ours.writer.scalars
    own = {("Train/mean_step_reward", it) for it in range(3)}
    # rsl_rl leaves the weight of the curiosity out until an episode has ended.
    extra = {("Rnd/weight", 0)} if rnd and entry == "finish_iteration" else set()
    assert written.keys() == expected.keys() | own | extra
    assert ("Train/mean_reward/time", 4) in expected
    for key, value in expected.items():
        assert written[key] == pytest.approx(value, rel=1e-5), key


def finish(logger: Any, it: int) -> IterationStats:
    return logger.finish_iteration(
        iteration=it, first_iteration=it, total_iterations=9, losses={}, collection_time=0.8,
        learning_time=0.7, rnd_weight=0.1, exploring={}, **REPORT,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("failures", "limit"), [(0.0, 40.0), (0.1, 40.0), (0.01, 10.0), (1.0, 7.0)]
)
def test_expected_lengths_are_truncated_geometric(failures, limit):
    survived = [(1.0 - failures) ** step for step in range(int(limit))]
    assert mean_length(failures, limit) == pytest.approx(sum(survived))


@pytest.mark.parametrize("with_time_outs", [False, True])
def test_the_exploring_return_needs_no_episode(
    with_time_outs,
):
    logger = make_logger(RunLogger, rnd=False)
    logger._reward_unit, logger._episode_steps = 0.02, 1000
    done = torch.zeros(NUM_ENVS, dtype=torch.long)
    extras = {"time_outs": torch.zeros(NUM_ENVS, dtype=torch.bool)} if with_time_outs else {}
    logger.process_env_step(torch.full((NUM_ENVS,), 0.75 * 0.02), done, extras)
    stats = finish(logger, 1)
    assert stats.mean_reward is None
    assert stats.exploring_return == pytest.approx(750.0)
    assert stats.exploring_length == 1000
    # All environments fail, or run out of time, in every step.
    if with_time_outs:
        extras["time_outs"] = ~extras["time_outs"]
    logger.process_env_step(torch.full((NUM_ENVS,), 0.75 * 0.02), done + 1, extras)
    assert finish(logger, 2).exploring_length == (1000 if with_time_outs else 1)


def test_the_time_left_is_without_the_warm_up(monkeypatch):
    logger = make_logger(RunLogger, rnd=False)
    now, left = 0.0, []
    monkeypatch.setattr("mjlab.rl.run_logger.time.perf_counter", lambda: now)
    # The first iteration compiles; the fourth evaluates. A session resumes after three iterations.
    for it, seconds in zip(range(3, 9), (600.0, 2.0, 2.0, 8.0, 2.0, 2.0), strict=True):
        now += seconds
        logger.process_env_step(torch.zeros(NUM_ENVS), torch.zeros(NUM_ENVS), {})
        stats = logger.finish_iteration(
            iteration=it, first_iteration=3, total_iterations=9, losses={}, collection_time=0.8,
            learning_time=0.7, rnd_weight=None, exploring={}, **REPORT,
        )  # fmt: skip
        left.append(stats.time_left)
    assert left == [None, None, 2.0 * 3, 4.0 * 2, 3.5, 0.0]


def test_custom_loops_write_the_exploring_return():
    logger = make_logger(RunLogger, rnd=False)
    logger._reward_unit, logger._episode_steps = 0.02, 1000
    extras = {"time_outs": torch.zeros(NUM_ENVS, dtype=torch.bool)}
    logger.process_env_step(torch.full((NUM_ENVS,), 0.015), torch.zeros(NUM_ENVS), extras)
    logger.log(
        it=0, start_it=0, total_it=3, loss_dict={}, collect_time=0.8, learn_time=0.7,
        rnd_weight=None, **REPORT,
    )  # fmt: skip
    assert logger.writer.scalars["Train/exploring_return", 0] == pytest.approx(750.0)


def test_a_resumed_run_goes_on_with_both_parts_of_the_reward():
    whole, first, resumed = (make_logger(RunLogger, rnd=True) for _ in range(3))
    for seed in (1, 2):
        for logger in (whole, first):
            feed(logger, True, seed)
            finish(logger, seed)
    resumed.load_state_dict(first.state_dict())
    for logger in (whole, resumed):
        feed(logger, True, 0)
        finish(logger, 3)
        feed(logger, True, 4)
        finish(logger, 4)
    for it in (3, 4):
        for part in ("mean_reward", "mean_extrinsic_reward", "mean_intrinsic_reward"):
            key = ("Train" if part == "mean_reward" else "Rnd") + f"/{part}", it
            assert resumed.writer.scalars[key] == whole.writer.scalars[key]


@pytest.mark.parametrize("saved_with_rnd", [False, True])
@pytest.mark.parametrize("entry", ["finish_iteration", "log"])
def test_checkpoints_without_the_parts_of_the_reward_are_resumed(saved_with_rnd, entry, capsys):
    first, resumed = make_logger(RunLogger, saved_with_rnd), make_logger(RunLogger, rnd=True)
    feed(first, saved_with_rnd, 1)
    finish(first, 1)
    state = first.state_dict()
    resumed.load_state_dict({key: value for key, value in state.items() if "trinsic" not in key})
    # No episode ends, then some do.
    for it in (0, 2):
        feed(resumed, True, it)
        if entry == "log":
            resumed.log(it, 0, 9, 0.8, 0.7, {}, rnd_weight=0.1, **REPORT)
        else:
            finish(resumed, it)
    assert ("Train/mean_step_reward", 0) in resumed.writer.scalars
    assert ("Rnd/mean_extrinsic_reward", 2) in resumed.writer.scalars


def test_the_type_is_known_once_there_is_a_writer(make_runner, tmp_path: Path):
    runner = make_runner(tmp_path / "run")
    assert runner.logger.logger_type is None
    runner.logger.init_logging_writer()
    assert runner.logger.logger_type == "tensorboard"
    runner.logger.stop_logging_writer()
    silent = make_runner()
    silent.logger.init_logging_writer()
    assert silent.logger.logger_type is None
    silent.logger.logger_type = "tensorboard"
    assert silent.logger.logger_type == "tensorboard"


class SavesBeside(MjlabOnPolicyRunner):
    """Overrides `save` as task packages do: the policy goes beside the checkpoint, and upstream."""

    def save(self, path: str, infos: dict | None = None) -> None:
        super().save(path, infos)
        folder, file = os.path.split(path)
        self.export_policy_to_onnx(folder, file.replace(".pt", ".onnx"))
        if self.logger.disable_logs:
            return
        if self.logger.logger_type in ["wandb"]:
            sys.modules["wandb"].save(os.path.join(folder, "theirs.onnx"), base_path=folder)
        rewards = self.logger.rewbuffer
        self.seen = {
            "type": self.logger.logger_type,
            "config": self.cfg["logger"],
            "log_dir": self.logger.log_dir,
            "reward": sum(rewards) / len(rewards) if rewards else None,
            "steps": self.logger.tot_timesteps,
        }
        if self.logger.writer is not None:
            self.logger.writer.add_scalar("Theirs/saved", 1.0, self.current_learning_iteration)


def test_a_runner_that_overrides_save_reads_what_rsl_rl_offered(make_runner, tmp_path: Path):
    run = tmp_path / "run"
    runner = make_runner(run, runner_cls=SavesBeside, env_cfg={"always_terminate": True})
    runner.add_git_repo_to_log(__file__)
    runner.learn(2)
    assert {"model_1.pt", "model_1.onnx"} <= {path.name for path in run.iterdir()}
    assert runner.seen["type"] == runner.seen["config"] == "tensorboard"
    assert runner.seen["log_dir"] == str(run)
    assert runner.seen["reward"] > 0.0
    assert runner.seen["steps"] == 2 * 5 * 8
    assert read_scalars(run, "Theirs/saved")[0].tolist()[-1] == 2


@pytest.mark.parametrize("logger", ["wandb", {"class_name": "WandbLogWriter", "project_name": "p"}])
def test_weights_and_biases_is_known_by_its_name_and_the_config_stays(
    make_runner, tmp_path: Path, monkeypatch, logger
):
    saved: list[str] = []
    client: Any = types.ModuleType("wandb")
    for name in ("init", "log", "finish"):
        setattr(client, name, lambda *args, **kwargs: None)
    client.save = lambda path, **kwargs: saved.append(Path(path).name)
    client.config = types.SimpleNamespace(update=lambda values: None)
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", client)
    monkeypatch.setattr("rsl_rl.utils.wandb_log_writer.wandb", client)
    runner = make_runner(tmp_path / "run", runner_cls=SavesBeside, logger=logger)
    runner.learn(1)
    assert runner.seen["type"] == "wandb"
    assert runner.seen["config"] == logger
    assert "theirs.onnx" in saved


class OwnLoop(MjlabOnPolicyRunner):
    """Runner with a custom training loop, here rsl_rl's."""

    learn = OnPolicyRunner.learn


def test_a_runner_with_a_loop_of_its_own_leaves_checkpoints_and_scalars(
    make_runner, tmp_path: Path, capsys
):
    run = tmp_path / "run"
    runner = make_runner(run, runner_cls=OwnLoop, env_cfg={"always_terminate": True})
    runner.learn(2)
    assert len(runner.logger.rewbuffer) == 2 * 5 * 8
    assert (run / "model_1.pt").is_file()
    assert "Mean reward" in capsys.readouterr().out
    for tag in ("Train/mean_reward", "Train/mean_step_reward", "Loss/value"):
        assert read_scalars(run, tag)[0].tolist() == [0, 1]
    assert plot_run(run).is_file()
    other = make_runner(tmp_path / "other")
    other.load(str(run / "model_1.pt"))


@pytest.mark.parametrize(
    ("settings", "kept", "uploaded"),
    [({}, True, False), ({"upload_git_diff": True}, True, True), ({"save_git_diff": False}, 0, 0)],
)
def test_uploads_of_repositories_are_opt_in(
    make_runner, tmp_path: Path, monkeypatch, settings, kept, uploaded
):
    task = tmp_path / "my_tasks"
    task.mkdir()
    for command in (
        "init",
        "-c user.name=a -c user.email=a@b.c commit --allow-empty -m First",
    ):
        subprocess.run(["git", *command.split()], cwd=task, check=True, capture_output=True)
    saved: list[str] = []
    client: Any = types.ModuleType("wandb")
    for name in ("init", "log", "finish"):
        setattr(client, name, lambda *args, **kwargs: None)
    client.save = lambda path, **kwargs: saved.append(Path(path).name)
    client.config = types.SimpleNamespace(update=lambda values: None)
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", client)
    monkeypatch.setattr("rsl_rl.utils.wandb_log_writer.wandb", client)
    monkeypatch.delenv("WANDB_DISABLE_CODE", raising=False)
    runner = make_runner(tmp_path / "run", logger="wandb", **settings)
    runner.add_git_repo_to_log(str(task / "__init__.py"))
    runner.learn(1)
    files = [path.name for path in tmp_path.glob("run/git/*")]
    assert files == ["my_tasks.diff"] * bool(kept)
    assert ("my_tasks.diff" in saved) == bool(uploaded)
    assert (os.environ.pop("WANDB_DISABLE_CODE", "") == "true") == (not uploaded)
