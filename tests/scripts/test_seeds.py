"""`train-seeds` and `plot-seeds`: one task over several seeds, and their figure."""

from __future__ import annotations

import subprocess
import sys

import pytest

TASK = "Mjlab-Cartpole-Swingup"


@pytest.fixture
def commands(monkeypatch) -> list[list[str]]:
    """Return the commands that would be run; every one succeeds, but that of seed 13."""
    seen: list[list[str]] = []

    def pretend(command, check):
        seen.append(command)
        failed = command[command.index("--agent.seed") + 1] == "13"
        return subprocess.CompletedProcess(command, 3 if failed else 0)

    monkeypatch.setattr(subprocess, "run", pretend)
    return seen


def test_each_seed_trains_once_and_to_the_end(run, commands):
    assert run("train_seeds", TASK, "--seeds", "3", "--num-envs", "64").status == 0
    assert len(commands) == 3
    for seed, command in enumerate(commands, start=1):
        assert command[:4] == [sys.executable, "-m", "mjlab.scripts.train", TASK]
        flags = dict(zip(command[4::2], command[5::2], strict=True))
        assert flags == {
            "--agent.evaluation.solved-return": "None",
            "--num-envs": "64",
            "--agent.seed": str(seed),
            "--agent.run-name": f"seed_{seed}",
        }


def test_five_seeds_are_the_default(run, commands):
    assert run("train_seeds", TASK).status == 0
    assert len(commands) == 5


@pytest.mark.parametrize("count", ["0", "-2", "many", None])
def test_a_number_of_seeds_that_is_none_is_refused(run, commands, count):
    flags = ["--seeds"] if count is None else ["--seeds", count]
    outcome = run("train_seeds", TASK, *flags)
    assert outcome.status == 1
    assert "--seeds is" in outcome.message
    assert not commands


def test_a_seed_that_fails_ends_the_series_and_is_named(run, commands):
    outcome = run("train_seeds", TASK, "--seeds", "20")
    assert outcome.status == 1
    assert "seed 13 ended with status 3" in outcome.message
    assert len(commands) == 13


def test_an_unknown_task_trains_nothing(run, commands):
    assert run("train_seeds", "No-Task").status == 1
    assert not commands


def test_the_figure_of_several_runs_is_drawn(run, trained, tmp_path):
    picture = tmp_path / "figures" / "seeds.png"
    outcome = run("plot_seeds", str(trained), str(trained), "--output", str(picture))
    assert outcome.status == 0, outcome.err
    assert outcome.out.strip() == str(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_is_no_run_is_named(run, trained, tmp_path):
    outcome = run("plot_seeds", str(trained), str(tmp_path / "nowhere"))
    assert outcome.status == 1
    assert str(tmp_path / "nowhere") in outcome.message
    empty = tmp_path / "empty"
    empty.mkdir()
    outcome = run("plot_seeds", str(empty), "--output", str(tmp_path / "x.png"))
    assert outcome.status == 1
    assert str(empty) in outcome.message
