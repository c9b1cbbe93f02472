"""`train --agent.resume`: choice of the run, its environments, and flags typed again."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


def test_a_resumed_run_keeps_its_environments(first, resume):
    outcome = resume()
    assert outcome.status == 0, outcome.err
    assert "Resuming with --num-envs 16" in outcome.out
    assert num_envs(new_run(first)) == 16
    assert "random numbers restart" not in outcome.err


@pytest.mark.parametrize("is_known", [True, False])
def test_a_resumed_run_keeps_its_drawn_seed(first, resume, is_known):
    if not is_known:
        (first / "params" / "agent.yaml").unlink()
    outcome = resume("--agent.seed", "-1")
    assert outcome.status == 0, outcome.err
    params = yaml.safe_load((new_run(first) / "params" / "agent.yaml").read_text())
    says = "7, as before" if is_known else f"{params['seed']}, drawn"
    assert f"Seed:    {says}" in outcome.out


def test_a_typed_number_of_environments_wins(first, resume):
    assert resume("--num-envs", "5").status == 0
    assert num_envs(new_run(first)) == 5


def test_older_checkpoints_resume_by_parameters(first, resume):
    without_training_state(first)
    assert resume().status == 0
    assert num_envs(new_run(first)) == 16


@pytest.mark.slow
def test_an_unknown_number_of_environments_is_told(first, resume):
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


@pytest.mark.parametrize("flags", [(), ("--agent.load-run", "2026-01-01_00-00-00")])
def test_a_run_of_another_task_is_refused_and_named(first, resume, flags):
    outcome = resume(*flags, task=OTHER)
    assert outcome.status == 1
    for part in (first.name, TASK, OTHER):
        assert part in outcome.message
    assert list(first.parent.iterdir()) == [first]


@pytest.mark.slow
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


@pytest.mark.parametrize(
    "flag",
    [
        "--agent.load-run",
    ],
)
def test_a_pattern_that_is_none_is_told(resume, flag):
    outcome = resume(flag, "*")
    assert outcome.status == 1
    assert flag in outcome.message
    assert "'*'" in outcome.message


def test_a_finished_run_says_so_and_makes_no_folder(first, resume):
    outcome = resume(iterations=2)
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


# Flags typed on resume: each acts, or is an error that names it.


SAC = (
    "--learner", "sac", "--agent.algorithm.batch-size", "64", "--agent.algorithm.num-updates", "1",
    "--agent.algorithm.learning-starts", "2", "--agent.algorithm.replay-steps", "40",
)  # fmt: skip


@pytest.fixture(scope="module")
def of_sac(train, tmp_path_factory) -> Path:
    return train(tmp_path_factory.mktemp("sac"), 2, *SAC)


@pytest.fixture
def resumed(run, trained, tmp_path) -> Callable[..., Any]:
    """Return a function that resumes a copy of a run: outcome, content and config of the new one."""
    number = 0

    def resumed(*flags: str, of: Path = trained) -> tuple[Any, dict[str, Any], dict[str, Any]]:
        nonlocal number
        number += 1
        first = shutil.copytree(of, tmp_path / str(number) / "cartpole" / of.name)
        root = ("--log-root", str(first.parents[1]), "--agent.max-iterations", "3")
        outcome = run("train", TASK, "--device", "cpu", "--agent.resume", "True", *root, *flags)
        new = [path for path in first.parent.iterdir() if path != first]
        if not new:
            return outcome, {}, {}
        params = {
            name: yaml.safe_load((new[0] / "params" / f"{name}.yaml").read_text())
            for name in ("env", "agent")
        }
        return outcome, load_checkpoint(new[0] / "model_2.pt"), params

    return resumed


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return True if all weights of two checkpoints are equal."""
    pairs = [
        (value, other[part][name])
        for part in ("actor_state_dict", "critic_state_dict")
        for name, value in one[part].items()
    ]
    return all(torch.equal(value, its) for value, its in pairs)


def rates(content: dict[str, Any]) -> list[float]:
    return [group["lr"] for group in content["optimizer_state_dict"]["param_groups"]]


def test_rates_and_seeds_act(resumed):
    flags = ("--agent.algorithm.schedule", "fixed")
    found = []
    for rate, seed in (("1e-5", "5"), ("1e-6", "6")):
        typed = (*flags, "--agent.algorithm.learning-rate", rate, "--agent.seed", seed)
        outcome, content, params = resumed(*typed)
        assert outcome.status == 0, outcome.err
        assert rates(content) == [float(rate)] == [params["agent"]["algorithm"]["learning_rate"]]
        assert params["agent"]["seed"] == params["env"]["seed"] == int(seed)
        found.append(content)
    assert not same(*found)


def test_flags_of_the_run_typed_again_change_nothing(resumed):
    """Job scripts repeat their command."""
    plain = resumed()[1]
    typed = ("--agent.seed", "7", "--agent.algorithm.learning-rate", "1e-3", "--num-envs", "16")
    outcome, content, _ = resumed(*typed)
    assert same(content, plain)
    assert "restart" not in outcome.err


def test_a_flag_that_cannot_act_is_an_error(resumed, of_sac):
    outcome, content, _ = resumed("--agent.actor.distribution-cfg.init-std", "0.3", of=of_sac)
    assert outcome.status == 1
    assert "distribution-cfg.init-std" in outcome.message
    # Without a run folder.
    assert not content


@pytest.mark.slow
def test_a_replay_of_another_run_is_an_error(resumed, of_sac, train, tmp_path):
    other = train(tmp_path / "other", 2, *SAC)
    mixed = shutil.copytree(of_sac, tmp_path / "mixed")
    shutil.copy(other / "replay_model_1.pt", mixed)
    outcome, content, _ = resumed(of=mixed)
    assert outcome.status == 1
    assert "replay_model_1.pt" in outcome.message
    assert "delete this file" in outcome.message
    assert not content
    (mixed / "replay_model_1.pt").unlink()
    outcome, content, _ = resumed(of=mixed)
    assert outcome.status == 0
    assert "replay starts empty" in outcome.err
