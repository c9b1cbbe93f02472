"""State of the code in the folder of a run."""

from __future__ import annotations

import logging
import subprocess
from pathlib import Path

import pytest

from mjlab.rl.run_logger import write_git_diff
from mjlab.runs import Run


def git(folder: Path, *arguments: str) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    subprocess.run(["git", *who, *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository whose only file has an uncommitted change."""
    folder = tmp_path / "my_tasks"
    folder.mkdir()
    git(folder, "init")
    (folder / "task.py").write_text("reward = 1\n")
    git(folder, "add", ".")
    git(folder, "commit", "-m", "First")
    (folder / "task.py").write_text("reward = 2\n")
    return folder


def test_uncommitted_changes_are_kept_and_told_once(repository, tmp_path, caplog):
    run = tmp_path / "run"
    with caplog.at_level(logging.INFO):
        path = write_git_diff(run, repository / "task.py")
        assert write_git_diff(run, repository / "task.py") is None
    assert path == run / "git" / "my_tasks.diff"
    assert "+reward = 2" in path.read_text()
    assert caplog.text.count("Uncommitted changes") == 1
    assert str(path) in caplog.text
    assert "save-git-diff" in caplog.text


def test_a_clean_repository_is_recorded_without_a_word(repository, tmp_path, caplog):
    git(repository, "commit", "-am", "Second")
    with caplog.at_level(logging.INFO):
        path = write_git_diff(tmp_path / "run", repository / "task.py")
    assert path is not None
    assert "git commit" in path.read_text()
    assert not caplog.text


def test_the_repository_around_an_installed_package_is_not_its_own(repository, tmp_path):
    installed = repository / ".venv" / "lib" / "site-packages" / "tasks"
    installed.mkdir(parents=True)
    (installed / "task.py").touch()
    assert write_git_diff(tmp_path / "run", installed / "task.py") is None


def test_code_without_a_repository_or_a_git_has_no_state(repository, tmp_path, monkeypatch):
    (tmp_path / "task.py").touch()
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert write_git_diff(tmp_path / "run", tmp_path / "task.py") is None
    monkeypatch.setenv("PATH", "")
    assert write_git_diff(tmp_path / "run", repository / "task.py") is None


def test_a_run_knows_its_commit(repository, tmp_path):
    folder = tmp_path / "run"
    assert Run(folder).commit is None
    write_git_diff(folder, repository / "task.py")
    head = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=repository, text=True)
    assert Run(folder).commit == head.strip()
    # Of two repositories, either may be the task's.
    (folder / "git" / "other.diff").write_text("--- git commit ---\n0123456789\n")
    assert Run(folder).commit is None
    (folder / "git" / "my_tasks.diff").unlink()
    assert Run(folder).commit == "0123456789"
