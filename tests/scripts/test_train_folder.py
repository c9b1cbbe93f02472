"""A run's folder: only for runs that begin, and only below the folder of all runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from commands import SMALL, TASK

from mjlab.rl import MjlabOnPolicyRunner
from mjlab.rl.divergence import RolloutWatch
from mjlab.runs.folder import NewRunFolder
from mjlab.utils.os import create_locked, temporary_path


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
        ("--agent.actor.activation", "unheard-of", "unheard-of"),
        ("--num-envs", "0", "num-envs"),
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

    monkeypatch.setattr(MjlabOnPolicyRunner, "_initial_observations", fail)
    outcome, left = attempt()
    assert "not today" in outcome.message
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


def test_a_run_name_may_have_a_separator(attempt, tmp_path):
    outcome, _ = attempt("--agent.run-name", "a/b")
    assert outcome.status == 0, outcome.err
    assert outcome.err.count("--agent.run-name: ") == 1
    assert len(list(tmp_path.glob("logs/cartpole/*_a/b/model_1.pt"))) == 1


@pytest.mark.parametrize("name", ["{outside}", "../outside"])
def test_an_experiment_may_be_anywhere(attempt, tmp_path, name):
    name = name.format(outside=tmp_path / "outside")
    outcome, _ = attempt("--agent.experiment-name", name)
    assert outcome.status == 0, outcome.err
    assert len(list(tmp_path.glob("outside/*/model_1.pt"))) == 1


def test_an_experiment_may_be_a_folder_in_a_folder(attempt, tmp_path):
    outcome, _ = attempt("--agent.experiment-name", "group/mine", "--agent.run-name", "a..b")
    assert outcome.status == 0, outcome.err
    assert len(list((tmp_path / "logs" / "group" / "mine").glob("*_a..b/model_1.pt"))) == 1


@pytest.mark.slow
def test_a_folder_that_takes_no_more_is_told_without_tracebacks(tmp_path):
    # As on a file system that turned read-only, the event file can no longer be written.
    program = (
        "import resource, signal, time\n"
        "now = time.time\n"
        "from mjlab.cli import display\n"
        "def limit(self, stats):\n"
        "    if stats.iteration < 3:\n        return\n"
        "    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (16, resource.RLIM_INFINITY))\n"
        # Event files are written every ten seconds.
        "    time.time = lambda: now() + 1000.0 * stats.iteration\n"
        "    time.sleep(0.02)\n"
        "display.RunRecorder.on_iteration = limit\n"
        "from mjlab.scripts.train import main\n"
        "main()\n"
    )
    flags = [TASK, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "60"]
    flags += ["--agent.save-interval", "1000"]
    done = subprocess.run(
        [sys.executable, "-c", program, *flags], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    (run_dir,) = (tmp_path / "cartpole").iterdir()
    assert f"error: The checkpoint '{run_dir}" in done.stderr
    assert done.stderr.count(f"no longer written to {run_dir}") == 1


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
