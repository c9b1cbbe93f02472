"""Runs: metadata, state, and the choice of a run and its checkpoint."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from mjlab.rl.checkpoint import latest_checkpoint
from mjlab.runs import Run, newest_run, resolve_checkpoint, runs_in
from mjlab.runs.folder import NewRunFolder, write_info
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.errors import UserError
from mjlab.utils.os import get_checkpoint_path

TASK = "Mjlab-Cartpole-Swingup"
SCORE = {"evaluations": [{"iteration": 3, "mean_return": 960.0, "solved": True}]}


def make_run(experiment: Path, name: str, *numbers: int, **info) -> Run:
    folder = experiment / name
    folder.mkdir(parents=True)
    for number in numbers:
        (folder / f"model_{number}.pt").write_bytes(b"")
    if info:
        write_info(folder, **info)
    return Run(folder)


def newest(experiment: Path, task: str = TASK) -> Path | None:
    run = newest_run(runs_in(experiment, task))
    return run and run.folder


def test_metadata_grow_and_the_newest_counts(tmp_path):
    write_info(tmp_path, task=TASK, ended=None)
    write_info(tmp_path, ended="solved")
    assert Run(tmp_path).info == {"task": TASK, "ended": "solved"}
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize("text", [None, "", "{half", "[1, 2]", "[" * 10**4, "9" * 5000])
def test_unreadable_metadata_are_empty(tmp_path, text):
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    run = Run(tmp_path)
    with pytest.warns(match="run.json cannot be read") if text is not None else nullcontext():
        assert run.info == {}
    assert (run.task, run.learner, run.profile) == (None, None, None)
    assert (run.settings, run.state) == ({}, "interrupted")


@pytest.mark.parametrize(
    "text", [None, "", "a: [", "just text", "- 1", "a: " + "[" * 10**4, "a: " + "9" * 5000]
)
def test_unreadable_parameters_are_empty(tmp_path, text):
    if text is not None:
        (tmp_path / "params").mkdir()
        (tmp_path / "params" / "agent.yaml").write_text(text)
    with pytest.warns(match="agent.yaml cannot be read") if text is not None else nullcontext():
        assert Run(tmp_path).params == {"env": {}, "agent": {}}
    assert Run(tmp_path, TASK).cfg().agent.max_iterations == 500


@pytest.mark.parametrize("kind", ["fifo", "device", "folder"])
def test_what_is_no_file_is_not_read(tmp_path, kind):
    make = {
        "fifo": os.mkfifo,
        "device": lambda path: path.symlink_to("/dev/zero"),
        "folder": Path.mkdir,
    }
    (tmp_path / "params").mkdir()
    for name in ("run.json", "params/env.yaml", "params/agent.yaml"):
        make[kind](tmp_path / name)
    run = Run(tmp_path)
    with pytest.warns(match=r"run.json cannot be read \(not a file\)"):
        assert run.info == {}
    with pytest.warns(match=r"(env|agent).yaml cannot be read \(not a file\)"):
        assert run.params == {"env": {}, "agent": {}}


def test_checkpoints_are_in_the_order_of_numbers(tmp_path):
    run = make_run(tmp_path, "run", 100, 20, 3)
    for name in ("model_7.pt.tmp", "model_x.pt", "xmodel_9.pt", ".model_8.pt.abc.tmp"):
        (run.folder / name).write_bytes(b"")
    assert [checkpoint.number for checkpoint in run.checkpoints] == [3, 20, 100]
    assert run.newest.number == 100
    assert make_run(tmp_path, "empty").newest is None


def test_folders_and_broken_links_are_no_checkpoints(tmp_path):
    run = make_run(tmp_path, "run", 3)
    for number, target in ((7, "nowhere"), (8, "model_8.pt"), (9, "model_8.pt")):
        (run.folder / f"model_{number}.pt").symlink_to(target)
    (run.folder / "model_99.pt").mkdir()
    os.mkfifo(run.folder / "model_100.pt")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").write_bytes(b"")
    assert run.newest.number == 3
    assert latest_checkpoint(run.folder) == run.newest.path
    assert newest_run(runs_in(tmp_path)).newest.number == 3
    assert get_checkpoint_path(tmp_path) == run.newest.path
    with pytest.raises(UserError, match=r"Available: .*model_3\.pt"):
        resolve_checkpoint(run.folder / "model_99.pt", TASK)


def test_a_policy_is_used_in_the_task_asked_for(tmp_path):
    make_run(tmp_path, "run", task=TASK, settings={"env.decimation": 2})
    other = "Mjlab-Cartpole-Balance"
    assert Run(tmp_path / "run").task == TASK
    run = Run(tmp_path / "run", other)
    assert (run.task, run.is_of(other, None), run.is_of(TASK, None)) == (other, False, True)
    assert run.cfg("play").env.decimation == 2
    assert set(run.cfg("play").env.rewards) == set(load_env_cfg(other, play=True).rewards)


def test_a_run_as_registered_keeps_its_profile(tmp_path):
    make_run(tmp_path, "run", task=TASK, profile="cpu", settings={"env.decimation": 2})
    run = Run(tmp_path / "run").as_registered()
    assert (run.profile, run.settings) == ("cpu", {})
    assert run.cfg().env.decimation == load_env_cfg(TASK).decimation


@pytest.mark.parametrize(
    ("name", "value", "success"),
    [("success_return", 5.0, 5.0), ("success_is_survival", True, "survival")],
)
def test_success_of_earlier_versions_is_kept(tmp_path, name, value, success):
    make_run(tmp_path, "run", task=TASK, settings={f"agent.evaluation.{name}": value})
    cfg = Run(tmp_path / "run").cfg()
    assert (cfg.agent.evaluation.success, cfg.left_out) == (success, {})


# State.


@pytest.mark.parametrize("ended", ["solved", "finished", "failed", "interrupted"])
def test_the_state_of_an_ended_run_is_recorded(tmp_path, ended):
    assert make_run(tmp_path, "run", ended=ended).state == ended


def test_a_run_is_running_until_its_process_ends(tmp_path):
    code = (
        "import sys; from pathlib import Path; from mjlab.runs.folder import NewRunFolder\n"
        "with NewRunFolder(Path(sys.argv[1]), 'x') as new:\n"
        "    new.keep(); print(new.path, flush=True); sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        folder = process.stdout.readline().strip()
        assert Run(folder).state == "running"
        process.kill()
        process.wait()
    # The file stays, the lock does not.
    assert Run(folder).state == "interrupted"


def test_a_run_of_this_process_is_running(tmp_path):
    with NewRunFolder(tmp_path, "") as new:
        new.keep()
        assert Run(new.path).state == "running"
    assert Run(new.path).state == "interrupted"
    assert list(new.path.iterdir()) == []


# Choice of a run.


def test_the_newest_run_is_running_evaluated_finished_or_has_a_checkpoint(tmp_path):
    saved = make_run(tmp_path, "2026-01-01_00-00-00", 1, task=TASK)
    assert newest(tmp_path) == saved.folder
    finished = make_run(tmp_path, "2025-01-02_00-00-00", 2, task=TASK, ended="finished")
    assert newest(tmp_path) == finished.folder
    solved = make_run(tmp_path, "2024-01-03_00-00-00", 3, task=TASK, ended="solved", **SCORE)
    assert newest(tmp_path) == solved.folder
    # Later starts of one iteration, or without a checkpoint, do not replace it.
    make_run(tmp_path, "2026-01-04_00-00-00", 0, task=TASK, ended="finished")
    make_run(tmp_path, "2026-01-05_00-00-00", task=TASK, **SCORE)
    assert newest(tmp_path) == solved.folder
    with NewRunFolder(tmp_path, "") as new:
        assert newest(tmp_path) == solved.folder
        (new.path / "model_0.pt").write_bytes(b"")
        assert newest(tmp_path) == new.path
        assert "running" in Run(new.path).describe()


def test_a_session_is_evaluated_if_an_earlier_one_was(tmp_path):
    make_run(tmp_path, "2026-01-01_00-00-00", 3, task=TASK, ended="interrupted", **SCORE)
    resumed = "2026-01-01_00-00-00/model_3.pt"
    later = make_run(tmp_path, "2026-01-02_00-00-00", 5, task=TASK, resumed=resumed)
    assert newest(tmp_path) == later.folder


def test_runs_of_other_tasks_and_learners_do_not_count(tmp_path):
    ours = make_run(tmp_path, "2026-01-02", 5, 50, task=TASK, learner="ppo")
    make_run(tmp_path, "2026-01-03", 9, task="Another-Task")
    (tmp_path / "2026-01-05").write_text("a file")
    assert newest(tmp_path) == ours.folder
    assert newest(tmp_path, "Third-Task") is None
    assert newest(tmp_path / "nowhere") is None
    assert runs_in(tmp_path, TASK, "sac") == []
    # Runs that record neither may be of any.
    unnamed = make_run(tmp_path, "run", 5)
    assert [run.folder for run in runs_in(tmp_path, "Third-Task", "sac")] == [unnamed.folder]


def test_runs_are_ordered_by_their_start(tmp_path):
    renamed = make_run(tmp_path, "best", 1, started="2026-03-01T10:00:00")
    older = make_run(tmp_path, "2026-02-01_10-00-00_long", 1)
    nameless = make_run(tmp_path, "zzz", 1)
    found = [run.folder for run in runs_in(tmp_path)]
    assert found == [renamed.folder, older.folder, nameless.folder]


def test_runs_are_found_by_their_name(tmp_path):
    expected = {
        make_run(tmp_path, name).folder for name in ("2026-01-01_seed_1", "2026-01-01_seed_1-2")
    }
    make_run(tmp_path, "2026-01-01_seed_11")
    assert {run.folder for run in runs_in(tmp_path, run_name="seed_1")} == expected


# Choice of a checkpoint.


def test_a_checkpoint_is_taken_where_it_is(tmp_path):
    run = make_run(tmp_path, "run", 5, 6)
    assert resolve_checkpoint(run.folder / "model_5.pt", TASK).path == run.folder / "model_5.pt"
    # A folder stands for its last checkpoint.
    assert resolve_checkpoint(run.folder, TASK).path == run.folder / "model_6.pt"
    renamed = (run.folder / "model_5.pt").rename(tmp_path / "best.pt")
    assert resolve_checkpoint(renamed, TASK).path == renamed


def test_the_folder_of_the_run_may_be_left_out(tmp_path):
    make_run(tmp_path, "2026-01-01_00-00-00", 5, 500, task=TASK)
    newer = make_run(tmp_path, "2026-01-02_00-00-00", 5, 300, task=TASK)
    assert resolve_checkpoint(tmp_path / "model_5.pt", TASK).path == newer.folder / "model_5.pt"


@pytest.mark.parametrize("ended", ["solved", "finished"])
def test_the_last_checkpoint_stands_in_for_a_later_one(tmp_path, ended, capsys):
    run = make_run(tmp_path, "run", 5, 41, task=TASK, ended=ended)
    assert resolve_checkpoint(tmp_path / "model_500.pt", TASK).path == run.newest.path
    assert f"was {ended} before model_500.pt" in capsys.readouterr().err
    with pytest.raises(UserError):
        resolve_checkpoint(tmp_path / "model_7.pt", TASK)


def test_an_interrupted_run_does_not_stand_in(tmp_path):
    run = make_run(tmp_path, "run", 5, 41, task=TASK, ended="interrupted")
    with pytest.raises(UserError) as caught:
        resolve_checkpoint(tmp_path / "model_500.pt", TASK)
    assert f"Checkpoint {tmp_path / 'model_500.pt'}" in str(caught.value)
    assert str(run.newest) in str(caught.value)


def test_without_checkpoints_the_message_names_the_command(tmp_path):
    with pytest.raises(UserError, match=f"`uv run mjlab train {TASK}` first"):
        resolve_checkpoint(tmp_path / "model_0.pt", TASK)
