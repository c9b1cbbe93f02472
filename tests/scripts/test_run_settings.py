"""Settings of a run: resumed, evaluated, played and used again as they were trained."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from commands import TASK

from mjlab.cli.flags import parse_flags
from mjlab.cli.main import main
from mjlab.rl.checkpoint import load_checkpoint, save_checkpoint
from mjlab.runs import Checkpoint, Run
from mjlab.runs.folder import write_info
from mjlab.runs.run import RUNNING_FILE
from mjlab.runs.settings import typed_settings
from mjlab.scripts.train import TrainConfig, launch_training, settings_to_record
from mjlab.tasks.tracking.motion_sources import (
    record_motions,
    recorded_motions,
    shipped_motions,
)
from mjlab.utils.os import create_locked

TYPED = (
    "--env.decimation", "2", "--env.rewards.smooth-reward.weight", "9",
    "--agent.algorithm.gamma", "0.5", "--agent.algorithm.learning-rate", "1e-4",
    "--agent.actor.hidden-dims", "(8,)", "--agent.critic.hidden-dims", "(8,)",
    "--agent.clip-actions", "0.5",
)  # fmt: skip
SETTINGS = {
    "env.decimation": 2,
    "env.rewards.smooth_reward.weight": 9.0,
    "agent.algorithm.gamma": 0.5,
    "agent.algorithm.learning_rate": 1e-4,
    "agent.actor.hidden_dims": [8],
    "agent.clip_actions": 0.5,
}
SHORT = ("--num-episodes", "4", "--max-steps", "6", "--device", "cpu", "--json")


@pytest.fixture(scope="module")
def typed(train, tmp_path_factory) -> Path:
    """Return a run trained with flags; not to be changed."""
    return train(tmp_path_factory.mktemp("typed") / "logs", 2, *TYPED)


@pytest.fixture
def first(typed, tmp_path) -> Path:
    """Return a copy of the run, in a log root of its own."""
    return shutil.copytree(typed, tmp_path / "logs" / "cartpole" / typed.name)


@pytest.fixture
def train_more(run, first):
    """Return a function that trains below the log root of `first`; the new run and the outcome."""

    def train_more(*flags: str, iterations: int = 3):
        before = set(first.parent.iterdir())
        argv = (TASK, "--device", "cpu", "--log-root", str(first.parents[1]))
        argv += ("--agent.max-iterations", str(iterations))
        outcome = run("train", *argv, *flags)
        assert outcome.status == 0, outcome.err
        (new,) = set(first.parent.iterdir()) - before
        return Run(new), outcome

    return train_more


def trained_with(run: Run) -> dict[str, object]:
    env, agent = run.params["env"], run.params["agent"]
    return {
        "env.decimation": env["decimation"],
        "env.rewards.smooth_reward.weight": env["rewards"]["smooth_reward"]["weight"],
        "agent.algorithm.gamma": agent["algorithm"]["gamma"],
        "agent.algorithm.learning_rate": agent["algorithm"]["learning_rate"],
        "agent.actor.hidden_dims": agent["actor"]["hidden_dims"],
        "agent.clip_actions": agent["clip_actions"],
    }


def test_a_run_records_its_settings(typed):
    recorded = Run(typed).settings
    assert SETTINGS.items() <= recorded.items()
    # Those of the machine and the session are not recorded.
    assert not any("num_envs" in path or "seed" in path for path in recorded)


def test_a_resume_keeps_and_prints_the_settings(first, train_more):
    new, outcome = train_more("--agent.resume", "True")
    assert trained_with(new) == SETTINGS
    assert (new.num_envs, new.seed) == (16, 7)
    assert new.joined[0].folder == first
    for path in SETTINGS:
        assert outcome.err.count(f"{path}: ") == 1
    again, _ = train_more("--agent.resume", "True", iterations=4)
    assert trained_with(again) == SETTINGS


def test_typed_flags_come_last_and_stay(train_more):
    # Also a flag with the registered value.
    flags = ("--env.decimation", "5", "--agent.algorithm.gamma", "0.7")
    new, _ = train_more("--agent.resume", "True", *flags)
    expected = {**SETTINGS, "env.decimation": 5, "agent.algorithm.gamma": 0.7}
    assert trained_with(new) == expected
    again, _ = train_more("--agent.resume", "True", iterations=4)
    assert trained_with(again) == expected


@pytest.mark.slow
def test_the_registered_task_is_resumed_if_asked_for(train_more, first):
    networks = ("--agent.actor.hidden-dims", "(8,)", "--agent.critic.hidden-dims", "(8,)")
    new, _ = train_more("--agent.resume", "True", "--as-registered", "True", *networks)
    assert trained_with(new)["env.decimation"] == 5
    assert new.joined[0].folder == first


def test_a_new_run_is_like_another(first, train_more):
    new, outcome = train_more("--like", str(first), "--agent.seed", "3")
    assert trained_with(new) == SETTINGS
    assert (new.num_envs, new.seed, new.info.get("resumed")) == (16, 3, None)
    assert "env.decimation: 2 (registered: 5)" in outcome.err


def test_auto_resumes_if_there_is_a_run(first, train_more):
    new, outcome = train_more("--agent.resume", "auto")
    assert "Resumed:" in outcome.out
    shutil.rmtree(new.folder)
    shutil.rmtree(first)
    new, outcome = train_more("--agent.resume", "auto", "--num-envs", "4", iterations=1)
    assert "Resumed:" not in outcome.out
    assert new.info.get("resumed") is None


@pytest.mark.slow
def test_auto_resumes_runs_of_its_name_only(first, train_more):
    name = ("--agent.resume", "auto", "--agent.run-name", "seed_2", "--num-envs", "4")
    new, outcome = train_more(*name, iterations=1)
    assert "Resumed:" not in outcome.out
    resumed, _ = train_more(*name, iterations=2)
    assert [run.folder for run in resumed.joined] == [new.folder, resumed.folder]


def test_python_starts_a_run_like_another(first, tmp_path):
    cfg = TrainConfig.from_task(TASK)
    cfg.device, cfg.log_root, cfg.like = "cpu", str(tmp_path / "new"), str(first)
    cfg.agent.max_iterations = 1
    assert trained_with(Run(launch_training(TASK, cfg))) == SETTINGS


def test_a_running_run_is_named_and_not_restarted(run, first, train_more):
    write_info(first, ended=None)
    with create_locked(first / RUNNING_FILE):
        argv = (TASK, "--device", "cpu", "--log-root", str(first.parents[1]))
        # Before its first checkpoint as well.
        for checkpoint in (".*", "none"):
            flags = ("--agent.resume", "auto", "--agent.load-checkpoint", checkpoint)
            outcome = run("train", *argv, *flags)
            assert outcome.status == 1
            assert f"{first} is still running" in outcome.message
        _, outcome = train_more("--agent.resume", "True")
        assert outcome.err.count("is still running") == 1


def test_auto_leaves_a_solved_run_alone(run, first):
    write_info(first, ended="solved")
    argv = (TASK, "--device", "cpu", "--log-root", str(first.parents[1]), "--agent.resume", "auto")
    outcome = run("train", *argv)
    assert outcome.status == 0, outcome.err
    assert "was solved" in outcome.out
    assert list(first.parent.iterdir()) == [first]


@pytest.mark.parametrize(
    "kind",
    [
        "*.pt",
        pytest.param("*.onnx", marks=pytest.mark.slow),
    ],
)
def test_evaluations_have_the_settings(run, first, kind):
    policy = sorted(first.glob(kind))[-1]
    outcome = run("evaluate", TASK, *SHORT, "--checkpoint-file", str(policy))
    assert outcome.status == 0, outcome.err
    own = json.loads(outcome.out)["mean_return"]
    assert "env.decimation: 2 (registered: 5)" in outcome.err
    argv = (*SHORT, "--as-registered", "True", "--checkpoint-file", str(first / "model_1.pt"))
    outcome = run("evaluate", TASK, *argv)
    assert outcome.status == 0, outcome.err
    assert json.loads(outcome.out)["mean_return"] != own
    typed = ("--env.decimation", "2", "--env.rewards.smooth-reward.weight", "9")
    outcome = run("evaluate", TASK, *argv, *typed)
    assert json.loads(outcome.out)["mean_return"] == pytest.approx(own, rel=1e-4)


@pytest.mark.slow
def test_policy_and_export_score_the_same_with_settings(run, first):
    scores = []
    for policy in (first / "model_1.pt", next(first.glob("*.onnx")), first):
        outcome = run("evaluate", TASK, *SHORT, "--checkpoint-file", str(policy))
        scores.append(json.loads(outcome.out)["mean_return"])
    assert scores == pytest.approx([scores[0]] * 3, rel=1e-4)


def test_play_has_the_settings_and_says_what_it_lacks(run, first):
    settings = {**Run(first).settings, "env.rewards.removed.weight": 2.0}
    write_info(first, settings=settings)
    flags = ("--device", "cpu", "--viewer", "none", "--num-steps", "3")
    outcome = run("play", TASK, *flags, "--log-root", str(first.parents[1]))
    assert outcome.status == 0, outcome.err
    assert "env.decimation: 2 (registered: 5)" in outcome.err
    assert "env.rewards.removed.weight: 2.0 of the run left out" in outcome.err
    assert f"Checkpoint: {first / 'model_1.pt'}" in outcome.err


def test_settings_of_earlier_runs_are_read_from_params(run, first):
    (first / "run.json").unlink()
    assert SETTINGS.items() <= Run(first, TASK).settings.items()
    outcome = run("evaluate", TASK, *SHORT, "--checkpoint-file", str(first / "model_1.pt"))
    assert outcome.status == 0, outcome.err
    assert "env.decimation: 2 (registered: 5)" in outcome.err


def test_python_callers_record_and_resume_their_changes(tmp_path):
    def config(iterations: int) -> TrainConfig:
        cfg = TrainConfig.from_task(TASK)
        cfg.device, cfg.num_envs, cfg.log_root = "cpu", 4, str(tmp_path)
        cfg.agent.num_steps_per_env, cfg.agent.max_iterations = 8, iterations
        return cfg

    cfg = config(1)
    cfg.env.decimation, cfg.agent.algorithm.gamma = 2, 0.5
    assert Run(launch_training(TASK, cfg)).settings.items() >= {
        "env.decimation": 2, "agent.algorithm.gamma": 0.5,
    }.items()  # fmt: skip
    cfg = config(2)
    cfg.agent.resume, cfg.agent.algorithm.gamma = True, 0.7
    resumed = Run(launch_training(TASK, cfg))
    assert trained_with(resumed)["env.decimation"] == 2
    assert trained_with(resumed)["agent.algorithm.gamma"] == 0.7


def test_recorded_numbers_out_of_range_warn(train_more, first):
    write_info(first, settings={**Run(first).settings, "agent.algorithm.gamma": 1.25})
    resumed, outcome = train_more("--agent.resume", "True")
    assert outcome.err.count("agent.algorithm.gamma: expected a number in [0, 1], got 1.25") == 1
    assert resumed.params["agent"]["algorithm"]["gamma"] == 1.25


# Changes of the task since.


def test_changes_of_the_code_are_listed(run, first, monkeypatch):
    from mjlab.tasks.cartpole import cartpole_env_cfg

    make = cartpole_env_cfg.cartpole_swingup_env_cfg

    def changed(*args, **kwargs):
        cfg = make(*args, **kwargs)
        cfg.sim.mujoco.timestep *= 2.0
        return cfg

    monkeypatch.setattr(cartpole_env_cfg, "cartpole_swingup_env_cfg", changed)
    outcome = run("evaluate", TASK, *SHORT, "--checkpoint-file", str(first / "model_1.pt"))
    assert outcome.status == 0, outcome.err
    assert "env.sim.mujoco.timestep: " in outcome.err
    assert "when the run was trained" in outcome.err


@pytest.mark.parametrize(
    "command",
    [
        "evaluate",
        pytest.param("train", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("knows_sizes", [True, False])
def test_terms_in_another_order_are_an_error(run, first, monkeypatch, command, knows_sizes):
    from mjlab.tasks.cartpole import cartpole_env_cfg

    make = cartpole_env_cfg.cartpole_swingup_env_cfg

    def reordered(*args, **kwargs):
        cfg = make(*args, **kwargs)
        for group in cfg.observations.values():
            group.terms = dict(reversed(group.terms.items()))
        return cfg

    monkeypatch.setattr(cartpole_env_cfg, "cartpole_swingup_env_cfg", reordered)
    path = first / "model_1.pt"
    if knows_sizes:
        shutil.rmtree(first / "params")
    else:
        save_checkpoint({k: v for k, v in load_checkpoint(path).items() if k != "sizes"}, path)
    flags = (*SHORT, "--checkpoint-file", str(path))
    if command == "train":
        flags = ("--device", "cpu", "--log-root", str(first.parents[1]), "--agent.resume", "True")
        flags += TYPED[8:12]
    outcome = run(command, TASK, *flags, "--as-registered", "True")
    assert outcome.status == 1
    assert "other terms, or in another order" in outcome.message
    assert "actor" in outcome.message


def test_a_resume_reads_its_checkpoint_once(train_more, first, monkeypatch):
    read = []
    load = torch.load

    def counted(file, *args, **kwargs):
        read.append(Path(file).name)
        return load(file, *args, **kwargs)

    monkeypatch.setattr(torch, "load", counted)
    train_more("--agent.resume", "True")
    assert read == ["model_1.pt"]


def test_a_checkpoint_says_what_it_is(first):
    checkpoint = Checkpoint(first / "model_1.pt")
    assert (checkpoint.task, checkpoint.learner, checkpoint.iteration) == (TASK, "ppo", 2)
    assert (checkpoint.num_envs, checkpoint.number) == (16, 1)
    assert set(checkpoint.weights) == {"actor", "critic"}
    assert checkpoint.sizes["actions"] == {"effort": [1]}
    assert checkpoint.identity is not None


def test_the_table_of_runs_names_settings_and_states(run_main, first):
    outcome = run_main(main, "mjlab", "runs", TASK, "--log-root", str(first.parents[1]), "--json")
    assert outcome.status == 0, outcome.err
    (row,) = json.loads(outcome.out)
    assert (row["run"], row["state"], row["iterations"]) == (first.name, "finished", 2)
    assert row["settings"]["env.decimation"] == 2


def test_a_run_like_another_reads_its_motion(run, tmp_path):
    first, task = tmp_path / "copied", "Mjlab-Tracking-Flat-Unitree-G1"
    record_motions([shipped_motions()["wave"]], first)
    write_info(first, task=task, learner="ppo", settings={})
    (first / "model_0.pt").touch()
    small = ("--num-envs", "2", "--agent.num-steps-per-env", "2", "--agent.max-iterations", "1")
    root = ("--like", str(first), "--log-root", str(tmp_path / "logs"), "--device", "cpu")
    assert run("train", task, *root, *small).status == 0
    (new,) = (tmp_path / "logs" / "g1_tracking").iterdir()
    assert [path.name for path in recorded_motions(new)] == ["wave.npz"]


def test_later_settings_replace_those_of_their_entries(tmp_path):
    task, scale = "Mjlab-Velocity-Flat-Unitree-Go1", "--env.actions.joint-pos.scale"
    each = "{'.*_hip_joint': 0.5, '.*_thigh_joint': 0.3, '.*_calf_joint': 0.2}"
    recorded = None
    for number, value in enumerate((each, "{'.*': 0.7}", each, "0.3")):
        flags = [scale, value]
        cfg = parse_flags(TrainConfig, TrainConfig.from_task(task), flags, "train")
        settings = settings_to_record(task, cfg, typed_settings(cfg.env, "env", flags), recorded)
        (tmp_path / str(number)).mkdir()
        write_info(tmp_path / str(number), task=task, settings=settings)
        recorded = Run(tmp_path / str(number))
        assert recorded.cfg().env.actions["joint_pos"].scale == cfg.env.actions["joint_pos"].scale
