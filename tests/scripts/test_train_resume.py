"""Resume: selection of the run, number of environments, finished runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
import yaml
from commands import TASK

from mjlab.rl.checkpoint import load_checkpoint
from mjlab.runs.folder import write_info

OTHER = "Mjlab-Cartpole-Balance"
STEPS = ("--agent.num-steps-per-env", "8", "--device", "cpu", "--agent.resume", "True")


@pytest.fixture
def first(trained, tmp_path) -> Path:
    """Return a copy of a finished run of 16 environments and two iterations."""
    return shutil.copytree(trained, tmp_path / "cartpole" / "2026-01-01_00-00-00")


@pytest.fixture
def resume(run, first):
    """Return a function that resumes below the folder of `first`."""

    def resume(*flags: str, task: str = TASK, iterations: int = 3):
        root = ("--log-root", str(first.parents[1]), "--agent.max-iterations", str(iterations))
        return run("train", task, *STEPS, *root, *flags)

    return resume


def new_run(first: Path) -> Path:
    (run_dir,) = set(first.parent.iterdir()) - {first}
    return run_dir


def num_envs(run_dir: Path) -> int:
    saved = load_checkpoint(run_dir / "model_2.pt")["training_state"]["num_envs"]
    params = yaml.safe_load((run_dir / "params" / "env.yaml").read_text())
    assert params["scene"]["num_envs"] == saved
    return saved


def without_training_state(run_dir: Path) -> None:
    for path in run_dir.glob("model_*.pt"):
        data = load_checkpoint(path)
        del data["training_state"]
        torch.save(data, path)


def test_it_has_the_environments_of_the_run_that_it_resumes(first, resume):
    outcome = resume()
    assert outcome.status == 0, outcome.err
    assert "Resuming with --num-envs 16" in outcome.out
    assert num_envs(new_run(first)) == 16
    assert "random numbers restart" not in outcome.err


@pytest.mark.parametrize("is_known", [True, False])
def test_a_seed_to_be_drawn_is_the_one_of_the_run_that_is_resumed(first, resume, is_known):
    if not is_known:
        (first / "params" / "agent.yaml").unlink()
    outcome = resume("--agent.seed", "-1")
    assert outcome.status == 0, outcome.err
    params = yaml.safe_load((new_run(first) / "params" / "agent.yaml").read_text())
    says = "7, as before" if is_known else f"{params['seed']}, drawn"
    assert f"Seed:    {says}" in outcome.out


@pytest.mark.parametrize("flag", ["--num-envs", "--env.scene.num-envs"])
def test_a_number_of_environments_that_is_given_wins(first, resume, flag):
    assert resume(flag, "5").status == 0
    assert num_envs(new_run(first)) == 5


def test_an_older_checkpoint_is_resumed_with_what_the_parameters_say(first, resume):
    without_training_state(first)
    assert resume().status == 0
    assert num_envs(new_run(first)) == 16


def test_where_nothing_says_how_many_environments_there_were_this_is_told(first, resume):
    without_training_state(first)
    shutil.rmtree(first / "params")
    outcome = resume()
    assert outcome.status == 0
    assert "does not record the number of environments" in outcome.err
    assert "--num-envs" in outcome.err


def test_runs_of_other_tasks_are_passed_over(first, resume):
    other = shutil.copytree(first, first.with_name("2026-01-02_00-00-00"))
    write_info(other, task=OTHER)
    outcome = resume()
    assert outcome.status == 0
    assert f"Resumed: {first / 'model_1.pt'}" in outcome.out


def test_a_run_that_names_no_task_is_of_any(first, resume):
    (first / "run.json").unlink()
    outcome = resume(task=OTHER)
    assert outcome.status == 0, outcome.err
    assert f"Resumed: {first / 'model_1.pt'}" in outcome.out


@pytest.mark.parametrize("flags", [(), ("--agent.load-run", "2026-01-01_00-00-00")])
def test_a_run_of_another_task_is_refused_and_named(first, resume, flags):
    outcome = resume(*flags, task=OTHER)
    assert outcome.status == 1
    for part in (first.name, TASK, OTHER):
        assert part in outcome.message
    assert list(first.parent.iterdir()) == [first]


def test_the_run_that_was_started_last_is_resumed(first, resume):
    # Renamed, and changed later.
    other = shutil.copytree(first, first.with_name("2099-01-01"))
    write_info(other, started="2020-01-01T10:00:00")
    outcome = resume()
    assert outcome.status == 0, outcome.err
    assert f"Resumed: {first / 'model_1.pt'}" in outcome.out
    # An explicit name takes precedence, and so does a checkpoint that only one run has.
    shutil.copy2(other / "model_0.pt", other / "model_7.pt")
    outcome = resume("--agent.load-checkpoint", "model_7.pt", iterations=1)
    assert f"{other / 'model_7.pt'} has finished" in outcome.out


@pytest.mark.parametrize("flag", ["--agent.load-run", "--agent.load-checkpoint"])
def test_a_pattern_that_is_none_is_told(resume, flag):
    outcome = resume(flag, "*")
    assert outcome.status == 1
    assert flag in outcome.message
    assert "'*'" in outcome.message


@pytest.mark.parametrize("iterations", [1, 2])
def test_a_finished_run_says_so_and_makes_no_folder(first, resume, iterations):
    outcome = resume(iterations=iterations)
    assert outcome.status == 0
    assert "has finished 2 iterations" in outcome.out
    assert "--agent.max-iterations" in outcome.out
    assert list(first.parent.iterdir()) == [first]


@pytest.mark.parametrize("spoilt", [True, False])
def test_a_checkpoint_that_is_refused_leaves_no_folder(first, resume, spoilt):
    if spoilt:
        (first / "model_1.pt").write_bytes(b"nothing")
    flags = ("--num-envs", "4") if spoilt else ("--agent.actor.hidden-dims", "(8,)")
    outcome = resume(*flags)
    assert outcome.status == 1
    assert str(first / "model_1.pt") in outcome.message
    assert list(first.parent.iterdir()) == [first]
