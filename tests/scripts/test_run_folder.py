"""Run folders: what they say about their run, and how checkpoints in them are found."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mjlab.scripts.run_folder import (
    checkpoints_in,
    newest_checkpoint,
    read_params,
    read_run_info,
    resolve_checkpoint,
    write_run_info,
)
from mjlab.utils.errors import UserError

TASK = "My-Task"


def make_run(experiment: Path, name: str, *numbers: int, changed: float = 1e9, **info) -> Path:
    run_dir = experiment / name
    run_dir.mkdir(parents=True)
    for number in numbers:
        (run_dir / f"model_{number}.pt").write_bytes(b"")
        os.utime(run_dir / f"model_{number}.pt", (changed, changed))
    if info:
        write_run_info(run_dir, **info)
    return run_dir


def test_what_a_folder_says_grows_and_the_newest_counts(tmp_path):
    write_run_info(tmp_path, task=TASK, ended=None)
    write_run_info(tmp_path, ended="solved")
    assert read_run_info(tmp_path) == {"task": TASK, "ended": "solved"}
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize("text", [None, "", "{half", "[1, 2]", "[" * 10**4, "9" * 5000])
def test_a_folder_that_says_nothing_readable_says_nothing(tmp_path, text):
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    assert read_run_info(tmp_path) == {}


@pytest.mark.parametrize(
    "text", [None, "", "a: [", "just text", "- 1", "a: " + "[" * 10**4, "a: " + "9" * 5000]
)
def test_unreadable_parameters_are_none(tmp_path, text):
    if text is not None:
        (tmp_path / "params").mkdir()
        (tmp_path / "params" / "agent.yaml").write_text(text)
    assert read_params(tmp_path, "agent") == {}


def test_checkpoints_come_in_the_order_of_their_numbers(tmp_path):
    run_dir = make_run(tmp_path, "run", 100, 20, 3)
    for name in ("model_7.pt.tmp", "model_x.pt", "xmodel_9.pt", ".model_8.pt.abc.tmp"):
        (run_dir / name).write_bytes(b"")
    assert [path.name for path in checkpoints_in(run_dir)] == [
        "model_3.pt", "model_20.pt", "model_100.pt",
    ]  # fmt: skip


def test_the_newest_checkpoint_is_of_the_newest_run_of_the_task_that_has_one(tmp_path):
    expected = make_run(tmp_path, "2026-01-02", 5, 50, task=TASK)
    make_run(tmp_path, "2026-01-01", 500, task=TASK)
    make_run(tmp_path, "2026-01-03", 9, task="Another-Task")
    make_run(tmp_path, "2026-01-04", task=TASK)
    (tmp_path / "2026-01-05").write_text("a file")
    assert newest_checkpoint(tmp_path, TASK) == expected / "model_50.pt"
    assert newest_checkpoint(tmp_path, "Third-Task") is None
    assert newest_checkpoint(tmp_path / "nowhere", TASK) is None


def test_the_newest_run_is_the_one_with_the_newest_checkpoint(tmp_path):
    make_run(tmp_path, "2026-01-09", 9)
    older = make_run(tmp_path, "2026-01-01_long", 1, 2, changed=2e9)
    assert newest_checkpoint(tmp_path, TASK) == older / "model_2.pt"
    assert resolve_checkpoint(tmp_path / "model_1.pt", TASK) == older / "model_1.pt"


def test_a_run_that_does_not_name_its_task_may_be_of_this_one(tmp_path):
    run_dir = make_run(tmp_path, "run", 5)
    assert newest_checkpoint(tmp_path, TASK) == run_dir / "model_5.pt"


def test_a_checkpoint_is_taken_where_it_is(tmp_path):
    run_dir = make_run(tmp_path, "run", 5)
    assert resolve_checkpoint(run_dir / "model_5.pt", TASK) == run_dir / "model_5.pt"
    renamed = (run_dir / "model_5.pt").rename(tmp_path / "best.pt")
    assert resolve_checkpoint(renamed, TASK) == renamed


def test_the_folder_of_the_run_may_be_left_out(tmp_path):
    make_run(tmp_path, "2026-01-01", 5, 500, task=TASK)
    newer = make_run(tmp_path, "2026-01-02", 5, 300, task=TASK)
    assert resolve_checkpoint(tmp_path / "model_5.pt", TASK) == newer / "model_5.pt"


@pytest.mark.parametrize("ended", ["solved", "finished"])
def test_a_run_that_ended_sooner_stands_in_with_its_last_checkpoint(tmp_path, ended, capsys):
    run_dir = make_run(tmp_path, "run", 5, 41, task=TASK, ended=ended)
    assert resolve_checkpoint(tmp_path / "model_500.pt", TASK) == run_dir / "model_41.pt"
    assert f"was {ended} before model_500.pt" in capsys.readouterr().err
    with pytest.raises(UserError):
        resolve_checkpoint(tmp_path / "model_7.pt", TASK)


def test_a_run_that_was_interrupted_does_not_stand_in(tmp_path):
    run_dir = make_run(tmp_path, "run", 5, 41, task=TASK, ended="interrupted")
    with pytest.raises(UserError) as caught:
        resolve_checkpoint(tmp_path / "model_500.pt", TASK)
    assert f"Checkpoint {tmp_path / 'model_500.pt'}" in str(caught.value)
    assert str(run_dir / "model_41.pt") in str(caught.value)


def test_where_there_are_no_checkpoints_the_message_says_how_to_make_some(tmp_path):
    with pytest.raises(UserError, match=f"`train {TASK}` first"):
        resolve_checkpoint(tmp_path / "model_0.pt", TASK)
