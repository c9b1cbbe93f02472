"""Selection of the run to resume, its profile and its learner."""

from __future__ import annotations

import pytest

SWINGUP, BALANCE = "Mjlab-Cartpole-Swingup", "Mjlab-Cartpole-Balance"


@pytest.fixture
def train(run, tmp_path):
    """Return a function that trains under `tmp_path` on the CPU."""

    def start(task: str, *flags: str):
        return run("train", task, "--log-root", str(tmp_path), "--device", "cpu", *flags)

    return start


def runs_in(tmp_path):
    return sorted(tmp_path.glob("cartpole/*"))


def test_a_run_goes_on_with_as_many_environments_as_it_had(train, tmp_path):
    assert train(SWINGUP, "--num-envs", "6", "--agent.max-iterations", "1").status == 0
    more = ("--agent.resume", "True", "--agent.max-iterations", "2")
    assert "6 environments" in train(SWINGUP, *more).out
    assert "3 environments" in train(SWINGUP, *more[:3], "3", "--num-envs", "3").out
    assert len(runs_in(tmp_path)) == 3


def test_a_finished_run_says_so_and_makes_no_folder(train, tmp_path):
    train(SWINGUP, "--num-envs", "4", "--agent.max-iterations", "1")
    again = train(SWINGUP, "--agent.resume", "True", "--agent.max-iterations", "1")
    assert again.status == 0
    assert "Nothing to train" in again.out
    assert "--agent.max-iterations " in again.out
    assert len(runs_in(tmp_path)) == 1


def test_a_run_of_another_task_is_not_continued(train, tmp_path):
    train(SWINGUP, "--num-envs", "4", "--agent.max-iterations", "1")
    other = train(BALANCE, "--agent.resume", "True")
    assert other.status == 1
    assert f"No run of {BALANCE}" in other.message
    named = train(BALANCE, "--agent.resume", "True", "--agent.load-run", "20.*")
    assert named.status == 1
    assert f"is of {SWINGUP}" in named.message
    assert len(runs_in(tmp_path)) == 1


@pytest.mark.parametrize(
    "flags",
    [
        ("--agent.actor.activation", "foo"),
        ("--env.actions.effort.actuator-names", "('nothing',)"),
    ],
)
def test_a_run_that_cannot_begin_leaves_no_folder(train, tmp_path, flags):
    assert train(SWINGUP, "--num-envs", "4", *flags).status == 1
    assert runs_in(tmp_path) == []
