"""Invalid requests: one clear message, status 1, and no data lost."""

from __future__ import annotations

import contextlib
import errno
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest
import torch

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs.mdp import JointEffortActionCfg
from mjlab.managers import (
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.rl import checkpoint as checkpoint_module
from mjlab.rl.checkpoint import load_checkpoint
from mjlab.tasks import registry

TASK = "Mjlab-Cartpole-Swingup"
SMALL = (
    "--num-envs", "4", "--device", "cpu", "--agent.num-steps-per-env", "4",
    "--agent.max-iterations", "2", "--agent.save-interval", "1",
)  # fmt: skip


@pytest.fixture
def attempt(run, tmp_path) -> Callable[..., str]:
    """Return a function that trains a task, expects status 1, and returns the one message."""

    def attempt(*flags: str, task: str = TASK, leaves_folder: bool = False) -> str:
        outcome = run("train", task, *SMALL, "--log-root", str(tmp_path / "logs"), *flags)
        assert outcome.status == 1, outcome.err
        # Only lines of this file, as a user's code.
        assert all(__file__ in line for line in outcome.err.splitlines() if "  File " in line)
        if not leaves_folder:
            assert not list((tmp_path / "logs").glob("*/*")), "a run that never began left a folder"
        return outcome.message

    return attempt


@pytest.fixture
def task_with(monkeypatch) -> Callable[[Callable[[ManagerBasedRlEnvCfg], None]], str]:
    """Return a function that registers cartpole with an edit, and returns the task's name."""
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))

    def register(edit: Callable[[ManagerBasedRlEnvCfg], None]) -> str:
        cfg = registry.load_env_cfg(TASK)
        edit(cfg)
        name = "Test-Edited-Cartpole"
        registry.register_mjlab_task(name, cfg, rl_cfg=registry.load_rl_cfg(TASK))
        return name

    return register


# Addresses of pages.


@pytest.mark.parametrize("host", ["300.1.2.3", "203.0.113.7"])
@pytest.mark.parametrize(
    ("script", "arguments", "flag"),
    [
        ("play", (TASK, "--viewer", "viser"), "--host"),
        ("train", (TASK, *SMALL, "--live"), "--live-host"),
        ("viz_nan", ("dump.npz",), "--host"),
        ("visualize_terrain", (), "--host"),
        ("csv_to_npz", ("--input-file", "poses.csv", "--view", "True"), "--host"),
    ],
)
def test_a_page_on_an_address_of_another_machine_is_refused_at_once(
    run, monkeypatch, tmp_path, script, arguments, flag, host
):
    monkeypatch.chdir(tmp_path)
    outcome = run(script, *arguments, flag, host)
    assert outcome.status == 1
    assert f"{flag}: expected an address of this machine, got {host!r}" in outcome.message
    assert not list(tmp_path.iterdir())


# Unknown names.


@pytest.mark.parametrize("script", ["train", "play", "evaluate"])
def test_an_unknown_task_is_answered_with_the_nearest_names(run, script):
    outcome = run(script, "Mjlab-Cartpole-Swing", "--num-envs", "4")
    assert outcome.status == 1
    assert "'Mjlab-Cartpole-Swing'" in outcome.message
    assert "did you mean 'Mjlab-Cartpole-Swingup'" in outcome.message
    assert "list-envs" in outcome.message


def test_a_name_like_no_task_is_answered_with_where_to_look(run):
    message = run("train", "zzz").message
    assert "list-envs" in message
    assert TASK in message


@pytest.mark.parametrize(
    "script",
    [
        "train",
    ],
)
def test_an_unknown_flag_ends_with_status_2_and_names_it(run, script):
    outcome = run(script, TASK, "--no-such-flag", "4")
    assert outcome.status == 2
    assert "--no-such-flag" in outcome.err


def test_an_actuator_pattern_matching_nothing_lists_the_candidates(attempt):
    message = attempt("--env.actions.effort.actuator-names", "('motor_.*',)")
    assert "motor_.*" in message
    assert "slider" in message


def test_a_joint_pattern_matching_nothing_lists_the_candidates(attempt):
    flag = "--env.rewards.smooth-reward.params.hinge-cfg.joint-names"
    message = attempt(flag, "('elbow',)")
    assert "elbow" in message
    assert "hinge_1" in message
    assert "smooth_reward" in message


def test_an_entity_that_is_not_there_lists_those_that_are(attempt, task_with):
    def edit(cfg):
        cfg.actions["effort"] = JointEffortActionCfg(entity_name="robot", actuator_names=(".*",))

    message = attempt(task=task_with(edit))
    assert "'robot'" in message
    assert "cartpole" in message


# Errors in tasks.


def _too_long(env):
    return torch.zeros(env.num_envs + 1)


def _a_matrix(env):
    return torch.zeros(env.num_envs, 2)


@pytest.mark.parametrize(
    ("kind", "func"),
    [
        ("rewards", _too_long),
        ("rewards", _a_matrix),
        ("terminations", _too_long),
        ("terminations", _a_matrix),
        ("observations", _too_long),
    ],
)
def test_a_term_returning_the_wrong_shape_is_named_with_both_shapes(attempt, task_with, kind, func):
    found = tuple(func(type("Env", (), {"num_envs": 4})).shape)

    def edit(cfg):
        term = {
            "rewards": lambda: RewardTermCfg(func=func, weight=1.0),
            "terminations": lambda: TerminationTermCfg(func=func),
            "observations": lambda: ObservationTermCfg(func=func),
        }[kind]()
        terms = cfg.observations["actor"].terms if kind == "observations" else getattr(cfg, kind)
        terms["mistaken"] = term

    # The first call of a reward or termination is in the first step, after the run has begun.
    message = attempt(task=task_with(edit), leaves_folder=True)
    assert "mistaken" in message
    assert str(found) in message
    assert "(4" in message


def test_a_term_that_lacks_a_parameter_is_named(attempt, task_with):
    def needs_more(env, asset_cfg, sigma):
        return torch.zeros(env.num_envs)

    def edit(cfg):
        cfg.rewards["mine"] = RewardTermCfg(
            func=needs_more, weight=1.0, params={"asset_cfg": SceneEntityCfg("cartpole")}
        )

    message = attempt(task=task_with(edit))
    assert "mine" in message
    assert "sigma" in message


@pytest.mark.parametrize(
    "xml",
    [
        "<mujoco><worldbody><body><geom type='box'/></body></worldbody></mujoco>",
        "<mujoco><worldbody>",
        "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>",
    ],
)
def test_a_model_that_does_not_compile_is_told_by_the_compilers_words(attempt, task_with, xml):
    def edit(cfg):
        cfg.scene.entities["cartpole"].spec_fn = lambda: mujoco.MjSpec.from_string(xml)

    message = attempt(task=task_with(edit))
    assert "cartpole" in message
    assert len(message) > 60


def test_a_model_file_that_is_missing_is_named(attempt, task_with):
    def edit(cfg):
        cfg.scene.entities["cartpole"].spec_fn = lambda: mujoco.MjSpec.from_file("/no/such.xml")

    assert "/no/such.xml" in attempt(task=task_with(edit))


# Numbers.


@pytest.mark.parametrize("count", ["0", "-3"])
def test_a_number_of_environments_below_one_is_refused(attempt, count):
    message = attempt("--num-envs", count)
    assert f"--num-envs: expected an integer >= 1, got {count}" in message


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("--env.decimation", "0"),
        ("--env.sim.mujoco.timestep", "-0.01"),
        ("--agent.num-steps-per-env", "0"),
    ],
)
def test_other_numbers_that_cannot_be_are_refused_by_name(attempt, flag, value):
    message = attempt(flag, value)
    assert flag.rpartition(".")[2].replace("-", "_") in message.replace("-", "_")


# Checkpoints.


@pytest.fixture
def resumable(trained, tmp_path) -> Path:
    """Return a checkpoint, in a copy of a finished run, that `--agent.resume True` would take."""
    run_dir = shutil.copytree(trained, tmp_path / "logs" / "cartpole" / "2026-01-01_00-00-00")
    return run_dir / "model_1.pt"


class Hostile:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        return (os.system, (f"touch {self.target}",))


def spoil(checkpoint: Path, how: str) -> None:
    if how == "truncated":
        checkpoint.write_bytes(checkpoint.read_bytes()[:2000])
    elif how == "hostile":
        torch.save({"actor_state_dict": Hostile(checkpoint.parent / "was_here")}, checkpoint)
    elif how == "plain pickle":
        hostile = {"actor_state_dict": Hostile(checkpoint.parent / "was_here")}
        checkpoint.write_bytes(pickle.dumps(hostile, protocol=2))


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("truncated", "corrupt"),
        ("hostile", "rejected"),
    ],
)
@pytest.mark.parametrize(
    "script",
    [
        pytest.param("train", marks=pytest.mark.slow),
        "play",
        pytest.param("evaluate", marks=pytest.mark.slow),
    ],
)
def test_a_spoilt_checkpoint_is_refused_and_not_run(run, resumable, tmp_path, script, how, words):
    spoil(resumable, how)
    content = resumable.read_bytes()
    flags = {
        "train": (*SMALL, "--agent.resume", "True", "--agent.max-iterations", "3"),
        "play": ("--viewer", "none", "--num-steps", "2", "--checkpoint-file", str(resumable)),
        "evaluate": ("--num-episodes", "2", "--checkpoint-file", str(resumable)),
    }[script]
    log_root = ("--log-root", str(tmp_path / "logs"))
    outcome = run(script, TASK, *flags, *log_root, "--device", "cpu")
    assert outcome.status == 1
    assert words in outcome.message
    assert str(resumable) in outcome.message
    assert not (resumable.parent / "was_here").exists()
    assert resumable.read_bytes() == content


def test_another_network_is_told_with_both_shapes(run, resumable, tmp_path):
    flags = ("--agent.resume", "True", "--agent.actor.hidden-dims", "(64,32)")
    outcome = run("train", TASK, *SMALL, *flags, "--log-root", str(tmp_path / "logs"))
    assert outcome.status == 1
    assert "[32, 64]" in outcome.message
    assert "[64, 64]" in outcome.message
    assert load_checkpoint(resumable)["iterations_finished"] == 2


def test_a_checkpoint_of_another_task_is_told(run, resumable, task_with):
    def edit(cfg):
        del cfg.observations["actor"].terms["pole_vel"]

    flags = ("--viewer", "none", "--num-steps", "2", "--device", "cpu")
    outcome = run("play", task_with(edit), *flags, "--checkpoint-file", str(resumable))
    assert outcome.status == 1
    assert "pole_vel" in outcome.message


@pytest.mark.parametrize("script", ["play", "evaluate"])
def test_a_missing_checkpoint_is_answered_with_those_there_are(run, resumable, script):
    resumable.with_name("run.json").unlink()
    missing = resumable.with_name("model_9.pt")
    outcome = run(script, TASK, "--checkpoint-file", str(missing), "--device", "cpu")
    assert outcome.status == 1
    assert str(missing) in outcome.message
    assert str(resumable) in outcome.message


def test_resuming_without_a_run_says_where_it_looked(attempt, tmp_path):
    message = attempt("--agent.resume", "True")
    assert str(tmp_path / "logs" / "cartpole") in message


def test_resuming_a_run_that_does_not_match_lists_those_there_are(run, resumable, tmp_path):
    flags = ("--agent.resume", "True", "--agent.load-run", "monday.*")
    outcome = run("train", TASK, *SMALL, *flags, "--log-root", str(tmp_path / "logs"))
    assert outcome.status == 1
    assert "monday" in outcome.message
    assert resumable.parent.name in outcome.message


# The disk.


def test_a_log_folder_that_cannot_be_written_is_told_before_training(run, tmp_path):
    (tmp_path / "file").write_text("in the way")
    outcome = run("train", TASK, *SMALL, "--log-root", str(tmp_path / "file" / "logs"))
    assert outcome.status == 1
    assert str(tmp_path / "file" / "logs") in outcome.message
    assert "--log-root" in outcome.message
    assert "iteration" not in outcome.out


def test_a_full_disk_keeps_the_previous_checkpoint(run, tmp_path, monkeypatch):
    replacing, write_text = checkpoint_module.replacing, Path.write_text

    def raise_if_full():
        if list(tmp_path.rglob("model_0.pt")):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    @contextlib.contextmanager
    def write_checkpoint(path, **kwargs):
        with replacing(path, **kwargs) as file:
            yield file
            raise_if_full()

    def write_small_file(self, text):
        raise_if_full()
        return write_text(self, text)

    monkeypatch.setattr(checkpoint_module, "replacing", write_checkpoint)
    monkeypatch.setattr(Path, "write_text", write_small_file)
    outcome = run("train", TASK, *SMALL, "--log-root", str(tmp_path))
    assert outcome.status == 1
    assert "disk is full" in outcome.message
    assert "--agent.resume True" in outcome.message
    (survivor,) = tmp_path.rglob("model_*")
    assert str(survivor) in outcome.message
    assert load_checkpoint(survivor)["iterations_finished"] == 1
    assert not list(tmp_path.rglob("*.tmp"))


# The machine.


@pytest.mark.parametrize("missing", ["warp", "mujoco_warp"])
def test_an_engine_whose_package_is_missing_is_refused_with_the_other(
    attempt, monkeypatch, missing
):
    monkeypatch.delitem(sys.modules, "mjlab.sim.warp.engine", raising=False)
    monkeypatch.setitem(sys.modules, missing, None)
    message = attempt("--engine", "warp")
    assert missing in message
    assert "--engine native" in message


def test_a_gpu_that_is_not_there_is_refused(attempt, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    message = attempt("--device", "cuda")
    assert "no CUDA GPU" in message
    assert "--device cpu" in message


def test_the_exit_status_reaches_the_shell():
    command = [sys.executable, "-m", "mjlab.scripts.train", "Mjlab-Cartpole-Swing"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("error: Unknown task 'Mjlab-Cartpole-Swing'; did you mean")
