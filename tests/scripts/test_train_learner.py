"""`train --learner`: SAC, and distillation from a teacher of PPO to a student."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path
from typing import Any

import onnxruntime
import pytest
import torch
import yaml
from commands import SMALL, TASK
from process_runs import ProcessRun

from mjlab.cli import training as environments
from mjlab.cli.policy_flags import env_cfg_of
from mjlab.cli.train_config import parse_train_flags
from mjlab.rl.checkpoint import load_checkpoint, save_checkpoint
from mjlab.rl.config import RslRlOffPolicyRunnerCfg
from mjlab.rl.learners import acting_cfg, with_learner
from mjlab.runs import Checkpoint, Run
from mjlab.runs.folder import write_info
from mjlab.runs.policy import agent_cfg_of, load_policy, make_env
from mjlab.scripts.evaluate import EvaluateConfig
from mjlab.scripts.train import TrainConfig
from mjlab.tasks import registry
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.processes import ProcessRank

SAC = (
    "--learner", "sac", "--agent.algorithm.batch-size", "64", "--agent.algorithm.replay-steps", "9",
    "--agent.algorithm.learning-starts", "2", "--agent.actor.hidden-dims", "(8,)",
)  # fmt: skip
OF_SAC = ("--agent.algorithm.batch-size", "32")


@pytest.fixture(scope="module")
def of_sac(train, tmp_path_factory) -> Path:
    """Return the folder of a run of two iterations by SAC; not to be changed."""
    return train(tmp_path_factory.mktemp("sac") / "logs", 2, *SAC)


@pytest.fixture
def first(of_sac, tmp_path) -> Path:
    """Return a copy of it."""
    return shutil.copytree(of_sac, tmp_path / "cartpole" / "2026-01-01_00-00-00")


# Flags.


def test_the_learner_decides_which_flags_there_are(capsys):
    for learner in (["--learner", "sac"], ["--learner=sac"]):
        agent: Any = parse_train_flags(TASK, [*OF_SAC, *learner], "train").agent
        assert isinstance(agent, RslRlOffPolicyRunnerCfg)
        assert agent.algorithm.batch_size == 32
        assert agent.experiment_name == "cartpole"
    assert parse_train_flags(TASK, ["--learner", "ppo"], "train").agent == (
        TrainConfig.from_task(TASK).agent
    )
    with pytest.raises(SystemExit):
        parse_train_flags(TASK, [*OF_SAC], "train")
    assert "--agent.algorithm.batch-size" in capsys.readouterr().err


def test_the_help_lists_the_flags_of_the_learner(run):
    for topic in ("", "agent"):
        outcome = run("train", TASK, "--learner", "sac", "--help", *filter(None, [topic]))
        assert "--agent.algorithm.num-updates" in outcome.out
        assert "num-mini-batches" not in outcome.out


@pytest.mark.parametrize("script", ["train", "train_seeds"])
def test_unknown_learners_list_the_known(run, script):
    outcome = run(script, TASK, "--learner", "td3")
    assert outcome.status == 1
    assert all(name in outcome.message for name in ("td3", "ppo", "sac", "distillation"))


def test_counts_of_sac_are_checked(run):
    outcome = run("train", TASK, "--learner", "sac", "--agent.algorithm.num-updates", "0")
    assert outcome.status == 1
    assert "--agent.algorithm.num-updates: expected an integer >= 1, got 0" in outcome.message


# The run.


def test_the_run_says_its_learner(of_sac):
    assert Run(of_sac).info["learner"] == "sac"
    params = yaml.safe_load((of_sac / "params" / "agent.yaml").read_text())
    assert params["algorithm"]["class_name"] == "mjlab.rl.sac:SAC"


def test_a_run_from_before_the_bounds_keeps_its_actions_within_one_scale(train, run, tmp_path):
    # Its joint ranges are 8 and 16 scales.
    task, flags = "Mjlab-Lift-Cube-Yam", ("--num-envs", "2", "--device", "cpu")
    root = ("--log-root", str(tmp_path))
    outcome = run("train", task, *SAC, *flags, *root, "--agent.max-iterations", "1")
    assert outcome.status == 0, outcome.message
    (run_dir,) = tmp_path.glob("*/*/")
    path = Run(run_dir).newest
    checkpoint = load_checkpoint(path)
    for state in (checkpoint["actor_state_dict"], checkpoint["sac_state_dict"]["actor"]):
        assert state.pop("distribution.bounds").max() > 8.0
    save_checkpoint(checkpoint, path)
    outcome = run("train", task, "--agent.resume", "True", *root, "--agent.max-iterations", "2")
    assert outcome.status == 0, outcome.message
    (resumed,) = set(run_dir.parent.iterdir()) - {run_dir}
    state = torch.load(Run(resumed).newest, weights_only=True)["actor_state_dict"]
    assert (state["distribution.bounds"] == 1.0).all()


@pytest.mark.parametrize(
    ("flags", "world_size", "threads"),
    [
        ([], 1, 2),
        (["--learner", "ppo"], 1, 3),
        (["--num-envs", "1"], 1, 1),
        (["--env.sim.num-threads", "3"], 1, 3),
        ([], 2, 3),
    ],
)
def test_the_physics_leaves_a_core_to_sac(monkeypatch, tmp_path, flags, world_size, threads):
    monkeypatch.setattr("mjlab.sim.native.engine.cores_per_process", lambda: 3)
    monkeypatch.setattr(environments, "cores_per_process", lambda: 3)
    cfg = parse_train_flags(TASK, ["--learner", "sac", "--num-envs", "4", *flags], "train")
    cfg.apply_short_forms(ProcessRank())
    before = cfg.env.sim.num_threads
    env = environments.training_env(cfg, "cpu", tmp_path, ProcessRank(0, world_size, 0, world_size))
    try:
        assert env.unwrapped.sim.capabilities.num_threads == threads
        # Nothing is learned while evaluations run.
        assert environments.evaluation_env_cfg(TASK, cfg, {}).sim.num_threads == before
    finally:
        env.close()


# Resuming.


def resume(run, first: Path, *flags: str):
    root = ("--log-root", str(first.parents[1]), "--agent.max-iterations", "3")
    steps = ("--agent.num-steps-per-env", "8", "--device", "cpu", "--agent.resume", "True")
    return run("train", TASK, *root, *steps, *flags)


def test_resuming_keeps_the_learner_and_takes_its_flags(run, first):
    # A run of another tool, or of an older release, does not say its learner.
    (first / "run.json").unlink()
    hidden = ("--agent.actor.hidden-dims", "(8,)", "--agent.algorithm.replay-steps", "9")
    outcome = resume(run, first, *hidden, *OF_SAC)
    assert outcome.status == 0, outcome.err
    assert "Resuming with the learner 'sac', as before." in outcome.err
    (new,) = set(first.parent.iterdir()) - {first}
    params = yaml.safe_load((new / "params" / "agent.yaml").read_text())
    assert params["algorithm"]["batch_size"] == 32
    assert Run(new).info["learner"] == "sac"


@pytest.mark.slow
def test_runs_of_ppo_resume_without_notice(run, trained, tmp_path):
    first = shutil.copytree(trained, tmp_path / "cartpole" / "2026-01-01_00-00-00")
    outcome = resume(run, first)
    assert outcome.status == 0, outcome.err
    assert "learner" not in outcome.err
    assert resume(run, first, *OF_SAC).status == 2


def test_a_profile_with_sac_keeps_runs_of_ppo(monkeypatch, trained, tmp_path, capsys):
    registry.list_tasks()
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    own = registry._tasks[TASK]
    registry.register_mjlab_task(
        "Test-Learner",
        own.env_cfg,
        rl_cfg=own.rl_cfg,
        profiles={"cpu": lambda env_cfg, rl_cfg: with_learner(rl_cfg, "sac")},
    )
    first = shutil.copytree(trained, tmp_path / "cartpole" / "2026-01-01_00-00-00")
    write_info(first, task="Test-Learner", profile="cpu")
    flags = ["--log-root", str(tmp_path), "--agent.resume", "True"]
    cfg = parse_train_flags("Test-Learner", flags, "train")
    assert (cfg.profile, cfg.learner) == ("cpu", "ppo")
    ppo = TrainConfig.from_task(TASK).agent
    assert type(cfg.agent) is type(ppo)
    assert "Resuming with the learner 'ppo'" in capsys.readouterr().err
    cfg = parse_train_flags("Test-Learner", ["--profile", "cpu"], "train")
    assert cfg.agent == with_learner(ppo, "sac")


def test_a_run_of_another_learner_is_refused_and_named(run, first):
    outcome = resume(run, first, "--learner", "ppo")
    assert outcome.status == 1
    assert f"{first.name} is of the learner 'sac'" in outcome.message
    # Learner recorded in the checkpoint only.
    (first / "run.json").unlink()
    outcome = resume(run, first, "--learner", "ppo")
    assert outcome.status == 1
    assert f"--learner: expected 'sac', which wrote {first / 'model_1.pt'}" in outcome.message
    assert list(first.parent.iterdir()) == [first]


# Policies.


def test_play_and_evaluate_need_not_be_told(run, of_sac, tmp_path):
    common = ("--log-root", str(of_sac.parents[1]), "--device", "cpu")
    short = ("--num-episodes", "4", "--max-steps", "3", "--json")
    outcome = run("evaluate", TASK, *short, *common)
    assert outcome.status == 0, outcome.err
    assert json.loads(outcome.out)["policy"] == str(of_sac / "model_1.pt")
    named = ("--checkpoint-file", str(of_sac / "model_1.pt"), "--learner", "ppo")
    outcome = run("play", TASK, "--viewer", "none", "--num-steps", "2", *common, *named)
    assert outcome.status == 1
    assert "--learner: expected 'sac'" in outcome.message


@pytest.mark.slow
def test_the_newest_policy_of_a_learner_is_played(run, first, trained):
    newer = shutil.copytree(trained, first.with_name("2026-01-02_00-00-00"))
    write_info(newer, started="2099-01-01T00:00:00")
    common = ("--log-root", str(first.parents[1]), "--device", "cpu")
    for flags, expected in (((), newer), (("--learner", "sac"), first)):
        outcome = run("play", TASK, "--viewer", "none", "--num-steps", "2", *common, *flags)
        assert outcome.status == 0, outcome.err
        assert f"Checkpoint: {expected / 'model_1.pt'}" in outcome.err
    (newer / "run.json").unlink()
    shutil.rmtree(first)
    write_info(newer, learner="ppo")
    outcome = run("play", TASK, "--viewer", "none", "--num-steps", "2", *common, *flags)
    assert "by the learner 'sac'" in outcome.message
    assert "`uv run mjlab train Mjlab-Cartpole-Swingup --learner sac`" in outcome.message


def test_sac_policies_act_as_their_export(of_sac):
    checkpoint = of_sac / "model_1.pt"
    cfg = acting_cfg(agent_cfg_of(TASK, Checkpoint(checkpoint)))
    assert cfg["actor"]["hidden_dims"] == (8,)
    assert cfg["algorithm"]["replay_steps"] == 1
    env_cfg = env_cfg_of(
        TASK, EvaluateConfig(num_envs=5), Checkpoint(checkpoint), purpose="evaluate"
    )
    env = make_env(TASK, env_cfg, "cpu")
    before = set(threading.enumerate())
    try:
        policy = load_policy(TASK, env, checkpoint, "cpu")
        observations = env.get_observations()
        with torch.inference_mode():
            actions = policy(observations)
            (exported,) = of_sac.glob("*.onnx")
            ours = load_policy(TASK, env, exported, "cpu")(observations)
    finally:
        env.close()
    assert set(threading.enumerate()) <= before
    session = onnxruntime.InferenceSession(exported)
    theirs = [
        session.run(["actions"], {"obs": row[None].numpy()})[0] for row in observations["actor"]
    ]
    assert actions.abs().max() < 1.0
    torch.testing.assert_close(torch.from_numpy(theirs[0]), actions[:1], atol=1e-5, rtol=0.0)
    torch.testing.assert_close(ours, actions, atol=1e-5, rtol=0.0)


# Other tasks and several processes.


@pytest.mark.parametrize(
    "task",
    [
        "Mjlab-Tracking-Flat-Unitree-G1",
        pytest.param("Mjlab-Velocity-Flat-Unitree-Go1", marks=pytest.mark.slow),
    ],
)
def test_tasks_with_custom_runners_learn_by_sac(run, tmp_path, task):
    common = ("--log-root", str(tmp_path), "--device", "cpu")
    small = ("--num-envs", "4", "--agent.max-iterations", "1", "--agent.num-steps-per-env", "3")
    profile = ("--profile", "cpu") if "Go1" in task else ()
    outcome = run("train", task, *common, *small, *profile, *SAC)
    assert outcome.status == 0, outcome.err
    outcome = run("play", task, *common, "--viewer", "none", "--num-steps", "2")
    assert outcome.status == 0, outcome.err
    (exported,) = tmp_path.glob("*/*/*.onnx")
    outputs = [output.name for output in onnxruntime.InferenceSession(exported).get_outputs()]
    assert ("joint_pos" in outputs) == ("Tracking" in task)


def test_two_processes_hold_the_same_networks(tmp_path):
    pair = ProcessRun(tmp_path, "--agent.max-iterations", "2", *SAC)
    ended = pair.end()
    assert [process.status for process in ended] == [0, 0], ended
    first, second = pair.probe(0)["weights"], pair.probe(1)["weights"]
    assert [name for name in first if not torch.equal(first[name], second[name])] == []
    assert not torch.equal(pair.probe(0)["qpos"], pair.probe(1)["qpos"])


# Distillation.


STUDENT = ("--learner", "distillation")


@pytest.fixture(scope="module")
def student(run, train, tmp_path_factory):
    """Return the runs of a teacher of another size than the task's, and of its student."""
    logs = tmp_path_factory.mktemp("distillation") / "logs"
    teacher = train(logs, 2, "--agent.actor.hidden-dims", "16,24")
    checkpoint = str([c.path for c in Run(teacher).checkpoints][-1])
    return teacher, train(logs, 2, *STUDENT, "--agent.teacher-checkpoint", checkpoint)


@pytest.fixture(scope="module")
def of_state(run, tmp_path_factory) -> Path:
    """Return the folder of a run of the lifting task without images."""
    logs = tmp_path_factory.mktemp("state")
    flags = [
        "--profile",
        "cpu",
        "--agent.actor.hidden-dims",
        "16,24",
        "--agent.max-iterations",
        "1",
    ]
    outcome = run("train", "Mjlab-Lift-Cube-Yam", *SMALL, "--log-root", str(logs), *flags)
    assert outcome.status == 0, outcome.err
    return next(logs.glob("*/*/model_0.pt")).parent


def test_the_teacher_has_the_network_of_its_run(student):
    agent = yaml.safe_load((student[1] / "params" / "agent.yaml").read_text())
    assert agent["teacher"]["hidden_dims"] == [16, 24]
    assert agent["student"]["hidden_dims"] == [64, 64]


def test_students_resume_and_evaluate(run, train, student):
    logs = student[1].parents[1]
    argv = ["--log-root", str(logs), "--device", "cpu"]
    resumed = train(logs, 3, "--agent.resume", "True", "--agent.load-run", student[1].name)
    outputs = []
    for path in ([c.path for c in Run(resumed).checkpoints][-1], next(resumed.glob("*.onnx"))):
        flags = ["--checkpoint-file", str(path), "--num-episodes", "4", "--seed", "3"]
        outcome = run("evaluate", TASK, *argv, *flags, "--env.episode-length-s", "2")
        assert outcome.status == 0, outcome.err
        outputs.append(next(line for line in outcome.out.splitlines() if "eturn" in line))
    assert outputs[0] == outputs[1]


def test_a_teacher_that_ppo_did_not_train_is_refused(run, student, tmp_path):
    argv = [TASK, *SMALL, "--log-root", str(tmp_path), *STUDENT, "--agent.teacher-checkpoint"]
    outcome = run("train", *argv, str([c.path for c in Run(student[1]).checkpoints][-1]))
    assert outcome.status == 1
    assert "expected a checkpoint of the learner 'ppo'" in outcome.message


def test_flags_that_would_teach_nothing_are_refused(run, student, tmp_path):
    teacher = str([c.path for c in Run(student[0]).checkpoints][-1])
    argv = [TASK, *SMALL, "--log-root", str(tmp_path), *STUDENT]
    outcome = run("train", *argv, "--agent.algorithm.gradient-length", "9")
    assert "gradient-length: expected at most 8" in outcome.message
    other = ["Mjlab-Reach-Yam", *argv[1:], "--agent.teacher-checkpoint", teacher]
    assert "was trained with other terms" in run("train", *other).message
    logs = ["--log-root", str(student[1].parents[1]), "--agent.resume", "True"]
    argv = [TASK, *SMALL, *logs, *STUDENT, "--agent.load-run", student[1].name]
    same = run("train", *argv, "--agent.teacher-checkpoint", str(student[0]))
    assert same.status == 0, same.message
    outcome = run("train", *argv, "--agent.teacher-checkpoint", "another.pt")
    assert f"expected {teacher} of the resumed run, got another.pt" in outcome.message


@pytest.mark.slow
def test_a_blind_student_follows_a_teacher_with_a_scan(run, tmp_path):
    task = "Mjlab-Velocity-Rough-Unitree-Go1"
    argv = [task, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "2"]
    for flags in (
        ["--profile", "cpu"],
        ["--profile", "blind", "--agent.teacher-checkpoint", f"{tmp_path}/go1_velocity/model_1.pt"],
    ):
        outcome = run("train", *argv, *flags)
        assert outcome.status == 0, outcome.err
    checkpoint = Run(max((tmp_path / "go1_velocity").iterdir())).newest.path
    for path in (checkpoint, next(checkpoint.parent.glob("*.onnx"))):
        flags = ["--checkpoint-file", str(path), "--num-episodes", "2", "--device", "cpu"]
        outcome = run("evaluate", task, *flags, "--env.episode-length-s", "1", "--seed", "1")
        assert outcome.status == 0, outcome.err


@pytest.mark.parametrize("task", ["Mjlab-Lift-Cube-Yam-Depth", "Mjlab-Multi-Cube-Seg-Yam"])
def test_a_student_of_images_follows_a_teacher_of_state(run, tmp_path, of_state, task):
    argv = [task, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "2"]
    flags = ["--profile", "student", "--agent.teacher-checkpoint", str(of_state)]
    outcome = run("train", *argv, *flags)
    assert outcome.status == 0, outcome.err
    checkpoint = max(tmp_path.glob("*/*/model_1.pt"))
    flags = ["--num-episodes", "2", "--device", "cpu", "--env.episode-length-s", "0.4"]
    outcome = run("evaluate", task, "--checkpoint-file", str(checkpoint), *flags)
    assert outcome.status == 0, outcome.err


def test_a_student_without_a_teacher_is_told_so(run, tmp_path):
    outcome = run("train", TASK, *SMALL, "--log-root", str(tmp_path), *STUDENT)
    assert outcome.status == 1
    assert "expected a teacher, got none" in outcome.message
    assert not list(tmp_path.glob("*/*"))


def test_the_blind_student_sees_no_ground():
    task = "Mjlab-Velocity-Rough-Unitree-Go1"
    groups = load_env_cfg(task, profile="blind").observations
    assert set(groups["actor"].terms) - set(groups["student"].terms) == {"height_scan"}
    cfg = load_rl_cfg(task, profile="blind")
    assert cfg.obs_groups == {"student": ("student",), "teacher": ("actor",)}
    teacher = load_rl_cfg(task, profile="cpu").actor
    assert cfg.teacher == teacher
    # The teacher's own learner under the student's profile, for playing the teacher in it.
    ppo = load_rl_cfg(task, profile="blind", learner="ppo")
    assert ppo.obs_groups == load_rl_cfg(task).obs_groups
