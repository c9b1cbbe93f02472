"""Distillation by command: a teacher of PPO, then its student."""

from __future__ import annotations

import pytest
import yaml
from commands import SMALL, TASK

from mjlab.runs import Run
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

STUDENT = ("--learner", "distillation")


@pytest.fixture(scope="module")
def student(run, train, tmp_path_factory):
    """Return the runs of a teacher of another size than the task's, and of its student."""
    logs = tmp_path_factory.mktemp("distillation") / "logs"
    teacher = train(logs, 2, "--agent.actor.hidden-dims", "16,24")
    checkpoint = str([c.path for c in Run(teacher).checkpoints][-1])
    return teacher, train(logs, 2, *STUDENT, "--agent.teacher-checkpoint", checkpoint)


def test_the_teacher_has_the_network_of_its_run(student):
    agent = yaml.safe_load((student[1] / "params" / "agent.yaml").read_text())
    assert agent["teacher"]["hidden_dims"] == [16, 24]
    assert agent["student"]["hidden_dims"] == [64, 64]


def test_a_student_is_resumed_evaluated_and_played_from_both_files(run, train, student):
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
    other = ["Mjlab-Cartpole-Balance", *argv[1:], "--agent.teacher-checkpoint", teacher]
    assert f"expected a checkpoint of Mjlab-Cartpole-Balance, got {teacher}" in (
        run("train", *other).message
    )
    logs = ["--log-root", str(student[1].parents[1]), "--agent.resume", "True"]
    argv = [TASK, *SMALL, *logs, *STUDENT, "--agent.load-run", student[1].name]
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


def test_a_student_without_a_teacher_is_told_so(run, tmp_path):
    outcome = run("train", TASK, *SMALL, "--log-root", str(tmp_path), *STUDENT)
    assert outcome.status == 1
    assert "expected a teacher, got none" in outcome.message
    assert not list(tmp_path.glob("*/*"))


def test_the_blind_student_of_rough_ground_sees_all_but_the_ground():
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
