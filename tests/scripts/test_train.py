"""`train`: flags, the files and folder of a run, repeatability, runners of other packages."""

from __future__ import annotations

import datetime
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import pytest
import torch
import yaml
from commands import SMALL, TASK
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mjlab.cli.flags import parse_flags
from mjlab.rl import MjlabOnPolicyRunner
from mjlab.rl.checkpoint import load_checkpoint
from mjlab.rl.rollout_watch import RolloutWatch
from mjlab.runs import Run, folder
from mjlab.runs.folder import NewRunFolder
from mjlab.scripts import train
from mjlab.scripts.train import TrainConfig, launch_training, run_train
from mjlab.tasks import registry
from mjlab.utils.os import create_locked, temporary_path


def config(*flags: str) -> TrainConfig:
    return parse_flags(TrainConfig, TrainConfig.from_task(TASK), list(flags), "train")


def weights(checkpoint: Path) -> dict[str, torch.Tensor]:
    data = load_checkpoint(checkpoint)
    return {
        f"{model}.{name}": value
        for model in ("actor", "critic")
        for name, value in data[f"{model}_state_dict"].items()
    }


def assert_same_weights(one: Path, other: Path) -> None:
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    assert [name for name in first if not torch.equal(first[name], second[name])] == []


def test_every_kind_of_field_has_a_flag():
    cfg: Any = config(
        "--env.scene.num-envs", "64",
        "--env.rewards.smooth-reward.weight", "2",
        "--env.events.reset-hinge.params.position-range", "(-1.0,1.0)",
        "--env.sim.engine", "warp",
        "--env.viewer.origin-type", "WORLD",
        "--agent.algorithm.learning-rate", "3e-4",
        "--agent.actor.hidden-dims", "(32,16)",
        "--agent.resume", "True",
        "--agent.logger", "wandb",
        "--agent.evaluation.stop-when-solved", "False",
        "--gpu-ids", "[0,1]",
        "--video",
        "--wandb-run-path", "me/project/abc",
        "--enable-nan-guard", "--log-root", "x",
    )  # fmt: skip
    assert cfg.env.scene.num_envs == 64
    assert cfg.env.rewards["smooth_reward"].weight == 2
    assert cfg.env.events["reset_hinge"].params["position_range"] == (-1.0, 1.0)
    assert cfg.env.sim.engine == "warp"
    assert cfg.env.viewer.origin_type.name == "WORLD"
    assert cfg.agent.algorithm.learning_rate == 3e-4
    assert cfg.agent.actor.hidden_dims == (32, 16)
    assert cfg.agent.resume
    assert cfg.agent.logger == "wandb"
    assert not cfg.agent.evaluation.stop_when_solved
    assert cfg.gpu_ids == [0, 1]
    assert cfg.video
    assert cfg.wandb_run_path == "me/project/abc"
    assert (cfg.enable_nan_guard, cfg.log_root) == (True, "x")


@pytest.mark.parametrize(("value", "expected"), [("all", "all"), ("None", None)])
def test_gpus_may_be_all_or_none(value, expected):
    assert config("--gpu-ids", value).gpu_ids == expected


def test_the_short_forms_win_over_the_task(train, tmp_path):
    flags = ("--engine", "native", "--agent.run-name", "mine", "--env.sim.mujoco.timestep", "0.02")
    run_dir = train(tmp_path, 1, *flags)
    assert run_dir.name.endswith("_mine")
    env = yaml.safe_load((run_dir / "params" / "env.yaml").read_text())
    assert env["scene"]["num_envs"] == 16
    assert env["sim"]["engine"] == "native"
    assert env["sim"]["mujoco"]["timestep"] == 0.02
    assert env["seed"] == 7


def test_a_drawn_seed_is_said(run, tmp_path):
    argv = [TASK, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "1"]
    outcome = run("train", *argv, "--seed", "-1")
    (drawn,) = (tmp_path / "cartpole").iterdir()
    agent, env = (
        yaml.safe_load((drawn / "params" / f"{name}.yaml").read_text()) for name in ("agent", "env")
    )
    assert agent["seed"] == env["seed"] >= 0
    assert f"--seed {agent['seed']} repeats the run" in outcome.out


def test_a_run_leaves_all_its_files(trained):
    assert {path.name for path in trained.glob("model_*.pt")} == {"model_0.pt", "model_1.pt"}
    agent = yaml.safe_load((trained / "params" / "agent.yaml").read_text())
    assert (agent["seed"], agent["max_iterations"]) == (7, 2)
    assert Run(trained).info["ended"] == "finished"
    assert Run(trained).info["iterations"] == 2
    assert Run(trained).info["task"] == TASK
    assert (trained / f"{trained.name}.onnx").stat().st_size > 1000
    assert (trained / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert list(trained.glob("events.out.tfevents.*"))
    assert not list(trained.rglob("*.tmp"))


def test_the_start_says_what_runs_where(run, tmp_path):
    argv = [TASK, "--num-envs", "4", "--device", "cpu", "--agent.max-iterations", "1"]
    argv += ["--agent.num-steps-per-env", "4", "--env.sim.num-threads", "1"]
    outcome = run("train", *argv, "--log-root", str(tmp_path))
    assert outcome.status == 0
    assert f"Task:    {TASK}, 4 environments" in outcome.out
    physics = next(line for line in outcome.out.splitlines() if line.startswith("Physics:"))
    for part in ("native", "cpu", "1 physics thread"):
        assert part in physics
    assert "Finished" in outcome.out
    assert "model_0.pt" in outcome.out


def test_runs_begun_at_once_have_two_folders(tmp_path, monkeypatch):
    class Stopped(datetime.datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 2, 3, 4, 5)

    monkeypatch.setattr(folder, "datetime", Stopped)
    with NewRunFolder(tmp_path, "") as one, NewRunFolder(tmp_path, "") as other:
        assert one.path.name == "2026-01-02_03-04-05"
        assert other.path.name == "2026-01-02_03-04-05-2"


def test_threads_of_the_physics_change_no_weight(train, tmp_path):
    one, two = (train(tmp_path / n, 1, "--env.sim.num-threads", n) for n in ("1", "2"))
    assert_same_weights(one / "model_0.pt", two / "model_0.pt")


def test_a_resumed_run_ends_as_one_never_stopped(train, trained, tmp_path):
    straight = train(tmp_path / "straight", 3)
    shutil.copytree(trained, tmp_path / "stopped" / "cartpole" / trained.name)
    resumed = train(tmp_path / "stopped", 3, "--agent.resume", "True")
    assert {path.name for path in resumed.glob("model_*.pt")} == {"model_2.pt"}
    assert_same_weights(straight / "model_2.pt", resumed / "model_2.pt")


def test_a_run_of_weights_and_biases_is_resumed(run, trained, tmp_path, monkeypatch):
    asked = []

    def fetch(experiment, run_path, name):
        asked.append((experiment, str(run_path), name))
        return trained / "model_1.pt", True

    monkeypatch.setattr("mjlab.cli.resume.get_wandb_checkpoint_path", fetch)
    outcome = run(
        "train", TASK, "--num-envs", "16", "--device", "cpu", "--agent.max-iterations", "3",
        "--agent.num-steps-per-env", "8", "--log-root", str(tmp_path), "--agent.resume", "True",
        "--wandb-run-path", "me/project/abc", "--wandb-checkpoint-name", "model_1.pt",
    )  # fmt: skip
    assert outcome.status == 0
    assert asked == [(tmp_path / "cartpole", "me/project/abc", "model_1.pt")]
    assert "iteration 2" in outcome.out


def test_nan_states_are_counted_and_reset(run, tmp_path, monkeypatch):
    from mjlab.envs import ManagerBasedRlEnv

    step = ManagerBasedRlEnv.step

    def poisoned(self, action):
        if self.common_step_counter == 4:
            self.sim.data.qvel[3] = float("nan")
        return step(self, action)

    monkeypatch.setattr(ManagerBasedRlEnv, "step", poisoned)
    dumps = tmp_path / "dumps"
    outcome = run(
        "train", TASK, "--num-envs", "16", "--device", "cpu", "--agent.max-iterations", "2",
        "--agent.num-steps-per-env", "8", "--log-root", str(tmp_path / "logs"),
        "--enable-nan-guard", "--env.sim.nan-guard.output-dir", str(dumps),
    )  # fmt: skip
    assert outcome.status == 0, outcome.err
    (run_dir,) = (tmp_path / "logs" / "cartpole").iterdir()
    events = EventAccumulator(str(run_dir)).Reload()
    counts = [event.value for event in events.Scalars("Simulation/nan_resets")]
    assert counts[0] > 0
    assert counts[1] == 0
    assert all(torch.isfinite(value).all() for value in weights(run_dir / "model_1.pt").values())
    assert list(dumps.glob("*.npz"))
    assert str(dumps) in outcome.err + outcome.out
    assert "1 of 16 environments" in outcome.out, "the end says how many environments diverged"
    assert "'cartpole/" in outcome.err, "the joint is named"


def test_diverging_physics_ends_training(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # Other libraries in this process set one: dm_control at import.
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(None)
    outcome = run(
        "train", TASK, "--num-envs", "16", "--device", "cpu", "--agent.max-iterations", "2",
        "--env.sim.mujoco.timestep", "100", "--env.episode-length-s", "1e5",
        "--env.sim.mujoco.integrator", "euler", "--log-root", str(tmp_path / "logs"),
    )  # fmt: skip
    mujoco.set_mju_user_warning(handler)
    assert outcome.status == 1
    assert "diverged" in outcome.err
    assert "timestep" in outcome.err
    assert len(outcome.err) < 10_000, outcome.err[:2000]
    assert [path.name for path in tmp_path.iterdir()] == ["logs"], "MuJoCo wrote its own log"


def test_training_stops_by_itself_once_solved(train, tmp_path):
    # Whatever the policy does, the return is at least zero.
    run_dir = train(
        tmp_path, 6, "--agent.evaluation.solved-return", "-1", "--agent.evaluation.num-episodes",
        "4", "--env.episode-length-s", "0.5", "--agent.evaluation.min-interval", "1",
    )  # fmt: skip
    assert Run(run_dir).info["ended"] == "solved"
    assert Run(run_dir).info["iterations"] < 6


def test_names_of_the_interface():
    assert run_train is launch_training
    with pytest.raises(AttributeError, match="no_such_name"):
        from mjlab.scripts import train

        train.no_such_name


# The folder of a run: only for runs that begin.


@pytest.fixture
def attempt(run, tmp_path):
    """Return a function that trains beside an older run's empty folder and checks that it is kept."""
    older = tmp_path / "logs" / "cartpole" / "2026-01-01_00-00-00"
    older.mkdir(parents=True)

    def attempt(*flags: str):
        root = ("--log-root", str(tmp_path / "logs"), "--agent.max-iterations", "2")
        outcome = run("train", TASK, *SMALL, *root, *flags)
        assert older.is_dir()
        return outcome, [path for path in older.parent.iterdir() if path != older]

    return attempt


@pytest.mark.parametrize(
    ("flag", "value", "told"),
    [
        ("--agent.algorithm.learning-rate", "nan", "learning-rate"),
        ("--env.actions.effort.actuator-names", "('nothing',)", "nothing"),
    ],
)
def test_a_run_that_cannot_begin_leaves_no_folder(attempt, flag, value, told):
    outcome, left = attempt(flag, value)
    assert outcome.status == 1
    assert told in outcome.message
    assert left == []


def test_a_run_that_fails_later_keeps_its_folder(attempt, monkeypatch):
    def fail(self):
        raise ValueError("not today")

    monkeypatch.setattr(RolloutWatch, "start", fail)
    outcome, (run_dir,) = attempt()
    assert "not today" in outcome.message
    assert (run_dir / "run.json").is_file()


def test_a_folder_with_a_checkpoint_is_never_removed(tmp_path):
    with NewRunFolder(tmp_path, "") as folder:
        (folder.path / "model_0.pt").touch()
    assert (folder.path / "model_0.pt").is_file()
    with NewRunFolder(tmp_path, "") as other:
        (other.path / "params").mkdir()
    assert list(tmp_path.iterdir()) == [folder.path]


def test_files_of_killed_runs_are_removed(tmp_path):
    older = tmp_path / "2026-01-01_00-00-00"
    clips = older / "videos" / "train"
    clips.mkdir(parents=True)
    left = [temporary_path(path) for path in (older / "model_1.pt", clips / "rl-video-step-0.mp4")]
    running = create_locked(temporary_path(older / "model_2.pt"))
    for path in (*left, older / "model_0.pt"):
        path.touch()
    with running, NewRunFolder(tmp_path, ""):
        pass
    files = [path for path in older.rglob("*") if path.is_file()]
    assert sorted(files) == sorted([older / "model_0.pt", Path(running.name)])


def test_a_run_name_may_have_a_separator(attempt, tmp_path):
    outcome, _ = attempt("--agent.run-name", "a/b")
    assert outcome.status == 0, outcome.err
    assert outcome.err.count("--agent.run-name: ") == 1
    assert len(list(tmp_path.glob("logs/cartpole/*_a/b/model_1.pt"))) == 1


@pytest.mark.slow
def test_a_killed_writer_leaves_what_is_removed(tmp_path):
    (tmp_path / "old").mkdir()
    program = (
        "import os, sys, torch\nfrom mjlab.rl import checkpoint\n"
        "torch.save = lambda *_: os.kill(os.getpid(), 9)\n"
        "checkpoint.save_checkpoint({}, sys.argv[1])\n"
    )
    path = tmp_path / "old" / "model_1.pt"
    subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    assert len(list(path.parent.iterdir())) == 1
    with NewRunFolder(tmp_path, ""):
        assert list(path.parent.iterdir()) == []


# Runners, algorithms and networks of other packages.


OWN = "Test-Own"
SEEN: dict = {}


class OwnRunner:
    """Runner with the methods that mjlab 1.6 calls, and files in its own format."""

    fails = False

    def __init__(self, env, train_cfg, log_dir=None, device="cpu"):
        self.env, self.log_dir = env, log_dir
        SEEN["cfg"] = train_cfg

    def add_git_repo_to_log(self, path):
        pass

    def learn(self, *, num_learning_iterations, init_at_random_ep_len):
        SEEN["learned"] = num_learning_iterations
        # Not plain data, so that only this class reads it.
        torch.save(SimpleNamespace(gain=0.5), f"{self.log_dir}/model_{num_learning_iterations}.pt")
        if self.fails:
            raise RuntimeError("the robot is on fire")

    def load(self, path, load_cfg=None, strict=True, map_location=None):
        SEEN["loaded"] = torch.load(path, weights_only=False).gain

    def save(self, path):
        pass

    def get_inference_policy(self, device=None):
        return lambda observations: torch.zeros(self.env.num_envs, self.env.num_actions)


class FailingRunner(OwnRunner):
    """`OwnRunner` whose training ends with an error."""

    fails = True


class RslRunner(OnPolicyRunner):
    """rsl_rl's runner, with the changes to the config that it needs."""

    def __init__(self, env, train_cfg, log_dir=None, device="cpu"):
        for network in ("actor", "critic"):
            for key in ("cnn_cfg", "rnn_type", "rnn_hidden_dim", "rnn_num_layers"):
                del train_cfg[network][key]
        super().__init__(env, train_cfg, log_dir, device)


class OwnModel(MLPModel):
    """Network with the arguments of mjlab 1.6's `MLPModel`."""

    def __init__(
        self, obs, obs_groups, obs_set, output_dim, hidden_dims=(8,), activation="elu",
        obs_normalization=False, distribution_cfg=None,
    ):  # fmt: skip
        super().__init__(
            obs, obs_groups, obs_set, output_dim, hidden_dims, activation, obs_normalization,
            distribution_cfg,
        )  # fmt: skip


class OwnPPO(PPO):
    """PPO with the arguments of mjlab 1.6's `PPO`."""

    def __init__(
        self, actor, critic, storage, num_learning_epochs=5, num_mini_batches=4, clip_param=0.2,
        gamma=0.99, lam=0.95, value_loss_coef=1.0, entropy_coef=0.01, learning_rate=1e-3,
        max_grad_norm=1.0, optimizer="adam", use_clipped_value_loss=True, schedule="adaptive",
        desired_kl=0.01, normalize_advantage_per_mini_batch=False, device="cpu", rnd_cfg=None,
        symmetry_cfg=None, multi_gpu_cfg=None,
    ):  # fmt: skip
        super().__init__(
            actor, critic, storage, num_learning_epochs, num_mini_batches, device=device
        )


@pytest.fixture
def own_task(monkeypatch):
    """Return a function that registers the cartpole with a runner or changed learner config."""
    registry.list_tasks()
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))

    def register(runner_cls=None, **classes):
        rl_cfg = registry.load_rl_cfg(TASK)
        for part, class_name in classes.items():
            getattr(rl_cfg, part).class_name = class_name
        registry.register_mjlab_task(
            OWN, registry.load_env_cfg(TASK), rl_cfg=rl_cfg, runner_cls=runner_cls
        )

    return register


def trains(run, logs, *flags):
    """Train the own task; return the outcome and the run folder."""
    argv = [OWN, *SMALL, "--log-root", str(logs), "--agent.max-iterations", "2", *flags]
    outcome = run("train", *argv)
    runs = sorted((logs / "cartpole").glob("*"))
    return outcome, runs[-1] if runs else None


def test_a_runner_needs_no_attributes(run, own_task, tmp_path):
    own_task(OwnRunner)
    outcome, folder = trains(run, tmp_path, "--live", "True")
    assert outcome.status == 0, outcome.err
    assert SEEN["learned"] == 2
    assert "no observers" in outcome.err
    info = Run(folder).info
    assert (info["ended"], info["iterations"]) == ("finished", 2)
    assert "use_mixed_precision" not in SEEN["cfg"]["algorithm"]
    assert SEEN["cfg"]["actor"]["cnn_cfg"] is None


def test_files_of_a_runner_resume_and_play(run, own_task, tmp_path):
    own_task(OwnRunner)
    _, first = trains(run, tmp_path)
    SEEN.clear()
    outcome, folder = trains(run, tmp_path, "--agent.resume", "True")
    assert outcome.status == 0, outcome.err
    # As rsl_rl's, it trains this number of further iterations.
    assert SEEN["loaded"] == 0.5
    assert SEEN["learned"] == 2
    assert folder != first
    argv = [OWN, "--log-root", str(tmp_path), "--device", "cpu"]
    for flags in (
        ("play", *argv, "--viewer", "none", "--num-steps", "2"),
        ("evaluate", *argv, "--num-episodes", "2", "--env.episode-length-s", "0.1"),
    ):
        SEEN.clear()
        outcome = run(*flags)
        assert outcome.status == 0, outcome.err
        assert SEEN["loaded"] == 0.5


def test_main_returns_after_training(own_task, tmp_path, monkeypatch):
    own_task(OwnRunner)
    argv = ["train", OWN, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "3"]
    monkeypatch.setattr("sys.argv", argv)
    train.main()
    assert SEEN["learned"] == 3


def test_a_failed_runner_keeps_its_folder(run, own_task, tmp_path):
    own_task(FailingRunner)
    outcome, folder = trains(run, tmp_path)
    assert outcome.status == 1
    assert "on fire" in outcome.err
    assert __file__ in outcome.err
    assert Run(folder).info["ended"] == "failed"
    assert (folder / "model_2.pt").exists()


@pytest.mark.slow
def test_a_runner_of_rsl_rl_trains_and_resumes(run, own_task, tmp_path):
    own_task(RslRunner)
    outcome, folder = trains(run, tmp_path)
    assert outcome.status == 0, outcome.err
    assert Run(folder).info["iterations"] == 1
    outcome, folder = trains(run, tmp_path, "--agent.resume", "True")
    assert outcome.status == 0, outcome.err
    assert sorted(path.name for path in folder.glob("model_*.pt"))[-1] == "model_2.pt"
    argv = [OWN, "--log-root", str(tmp_path), "--device", "cpu", "--viewer", "none"]
    outcome = run("play", *argv, "--num-steps", "2")
    assert outcome.status == 0, outcome.err


@pytest.mark.parametrize("runner_cls", [MjlabOnPolicyRunner, RslRunner])
def test_algorithms_and_networks_of_releases_train(run, own_task, tmp_path, runner_cls):
    own_task(
        runner_cls,
        algorithm=f"{__name__}:OwnPPO",
        actor=f"{__name__}:OwnModel",
        critic=f"{__name__}:OwnModel",
    )
    outcome, _ = trains(run, tmp_path)
    assert outcome.status == 0, outcome.err
