"""`train`: flags, the files of a run, repeatability, and resuming."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest
import torch
import yaml
from commands import SMALL
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mjlab.cli.flags import parse_flags
from mjlab.rl.checkpoint import load_checkpoint
from mjlab.runs import Run
from mjlab.scripts.train import TrainConfig, launch_training, run_train

TASK = "Mjlab-Cartpole-Swingup"


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


def test_the_tutorials_overrides_reach_the_config():
    cfg = config(
        "--num-envs", "8192",
        "--agent.algorithm.learning-rate", "3e-4",
        "--agent.algorithm.entropy-coef", "0.005",
        "--env.sim.mujoco.timestep", "0.005",
    )  # fmt: skip
    assert cfg.num_envs == 8192
    assert cfg.agent.algorithm.learning_rate == 3e-4  # ty: ignore
    assert cfg.agent.algorithm.entropy_coef == 0.005  # ty: ignore
    assert cfg.env.sim.mujoco.timestep == 0.005


@pytest.mark.parametrize(
    ("flags", "read", "expected"),
    [
        (["--env.scene.num-envs", "64"], lambda c: c.env.scene.num_envs, 64),
        (["--env.rewards.smooth-reward.weight", "2"], lambda c: c.env.rewards["smooth_reward"].weight, 2),
        (["--env.events.reset-hinge.params.position-range", "(-1.0,1.0)"],
         lambda c: c.env.events["reset_hinge"].params["position_range"], (-1.0, 1.0)),
        (["--env.sim.engine", "warp"], lambda c: c.env.sim.engine, "warp"),
        (["--env.sim.num-threads", "3"], lambda c: c.env.sim.num_threads, 3),
        (["--env.viewer.origin-type", "WORLD"], lambda c: c.env.viewer.origin_type.name, "WORLD"),
        (["--agent.actor.hidden-dims", "(32,16)"], lambda c: c.agent.actor.hidden_dims, (32, 16)),
        (["--agent.resume", "True"], lambda c: c.agent.resume, True),
        (["--agent.logger", "wandb"], lambda c: c.agent.logger, "wandb"),
        (["--agent.evaluation.stop-when-solved", "False"],
         lambda c: c.agent.evaluation.stop_when_solved, False),
        (["--gpu-ids", "[0,1]"], lambda c: c.gpu_ids, [0, 1]),
        (["--gpu-ids", "all"], lambda c: c.gpu_ids, "all"),
        (["--gpu-ids", "None"], lambda c: c.gpu_ids, None),
        (["--video"], lambda c: c.video, True),
        (["--wandb-run-path", "me/project/abc"], lambda c: c.wandb_run_path, "me/project/abc"),
        (["--enable-nan-guard", "--log-root", "x"], lambda c: (c.enable_nan_guard, c.log_root), (True, "x")),
    ],
)  # fmt: skip
def test_every_kind_of_field_has_a_flag(flags, read, expected):
    assert read(config(*flags)) == expected


def test_the_short_forms_win_over_the_task(train, tmp_path):
    flags = ("--engine", "native", "--agent.run-name", "mine", "--env.sim.mujoco.timestep", "0.02")
    run_dir = train(tmp_path, 1, *flags)
    assert run_dir.name.endswith("_mine")
    env = yaml.safe_load((run_dir / "params" / "env.yaml").read_text())
    assert env["scene"]["num_envs"] == 16
    assert env["sim"]["engine"] == "native"
    assert env["sim"]["mujoco"]["timestep"] == 0.02
    assert env["seed"] == 7


def test_a_drawn_seed_is_said_and_repeats_the_run(run, train, tmp_path):
    argv = [TASK, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "1"]
    outcome = run("train", *argv, "--agent.seed", "-1")
    (drawn,) = (tmp_path / "cartpole").iterdir()
    agent, env = (
        yaml.safe_load((drawn / "params" / f"{name}.yaml").read_text()) for name in ("agent", "env")
    )
    assert agent["seed"] == env["seed"] >= 0
    assert f"--agent.seed {agent['seed']} repeats the run" in outcome.out
    again = train(tmp_path, 1, "--agent.seed", str(agent["seed"]))
    assert_same_weights(drawn / "model_0.pt", again / "model_0.pt")


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


def test_two_runs_begun_at_once_have_folders_of_their_own(train, tmp_path, monkeypatch):
    import datetime

    from mjlab.runs import folder

    class Stopped(datetime.datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 2, 3, 4, 5)

    monkeypatch.setattr(folder, "datetime", Stopped)
    names = [train(tmp_path, 1).name for _ in range(2)]
    assert names == ["2026-01-02_03-04-05", "2026-01-02_03-04-05-2"]


def test_the_same_seed_gives_the_same_weights_whatever_the_physics_threads(train, tmp_path):
    one = train(tmp_path / "a", 3, "--env.sim.num-threads", "1")
    two = train(tmp_path / "b", 3, "--env.sim.num-threads", "2")
    assert_same_weights(one / "model_2.pt", two / "model_2.pt")
    other = train(tmp_path / "c", 3, "--agent.seed", "8")
    with pytest.raises(AssertionError):
        assert_same_weights(one / "model_2.pt", other / "model_2.pt")


def test_a_resumed_run_ends_with_the_weights_of_one_that_never_stopped(train, tmp_path):
    straight = train(tmp_path / "straight", 4)
    train(tmp_path / "stopped", 2)
    resumed = train(tmp_path / "stopped", 4, "--agent.resume", "True")
    assert {path.name for path in resumed.glob("model_*.pt")} == {"model_2.pt", "model_3.pt"}
    assert_same_weights(straight / "model_3.pt", resumed / "model_3.pt")


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


def test_a_state_that_turns_nan_is_counted_and_the_run_goes_on(run, tmp_path, monkeypatch):
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


def test_physics_that_diverges_nearly_everywhere_ends_training(run, tmp_path, monkeypatch):
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


def test_the_names_of_the_parts_are_those_of_the_interface():
    assert run_train is launch_training
    with pytest.raises(AttributeError, match="no_such_name"):
        from mjlab.scripts import train

        train.no_such_name
