"""A run's folder: only for runs that begin, and only below the folder of all runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import SMALL, TASK

from mjlab.rl import MjlabOnPolicyRunner
from mjlab.scripts.run_folder import NewRunFolder
from mjlab.utils.os import create_locked, temporary_path


@pytest.fixture
def attempt(run, tmp_path):
    """Return a function that trains beside an older run's empty folder, which has to stay."""
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
        ("--agent.algorithm.learning-rate", "nan", "learning rate"),
        ("--agent.actor.activation", "unheard-of", "unheard-of"),
        ("--num-envs", "0", "num_envs"),
    ],
)
def test_a_run_that_cannot_begin_leaves_no_folder(attempt, flag, value, told):
    outcome, left = attempt(flag, value)
    assert outcome.status == 1
    assert told in outcome.message
    assert left == []


def test_a_run_that_fails_before_its_first_iteration_leaves_no_folder(attempt, monkeypatch):
    def fail(self, init_at_random_ep_len):
        assert list(Path(self.logger.log_dir).iterdir())
        raise ValueError("not today")

    monkeypatch.setattr(MjlabOnPolicyRunner, "_start", fail)
    outcome, left = attempt()
    assert "not today" in outcome.message
    assert left == []


def test_a_run_that_fails_later_keeps_its_folder(attempt, monkeypatch):
    def fail(self, observations):
        raise ValueError("not today")

    monkeypatch.setattr(MjlabOnPolicyRunner, "_collect", fail)
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


def test_what_a_killed_run_was_writing_is_removed_at_the_next_start(tmp_path):
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


@pytest.mark.parametrize("name", ["a/b", "../up", "/abs", "a\\b"])
def test_a_run_name_with_a_separator_is_refused(attempt, tmp_path, name):
    outcome, left = attempt("--agent.run-name", name)
    assert outcome.status == 1
    assert f"--agent.run-name is {name!r}" in outcome.message
    assert left == []
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


@pytest.mark.parametrize("name", ["{outside}", "../up", "a/../../up", "..\\up"])
def test_an_experiment_outside_the_folder_of_all_runs_is_refused(attempt, tmp_path, name):
    name = name.format(outside=tmp_path / "outside")
    outcome, _ = attempt("--agent.experiment-name", name)
    assert outcome.status == 1
    assert f"--agent.experiment-name is {name!r}" in outcome.message
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


def test_an_experiment_may_be_a_folder_in_a_folder(attempt, tmp_path):
    outcome, _ = attempt("--agent.experiment-name", "group/mine", "--agent.run-name", "a..b")
    assert outcome.status == 0, outcome.err
    assert len(list((tmp_path / "logs" / "group" / "mine").glob("*_a..b/model_1.pt"))) == 1
