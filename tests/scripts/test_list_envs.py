"""`list-envs` lists tasks and says by its status whether there were any."""

from __future__ import annotations

import pytest

from mjlab.runs.reference import DATA, Reference, reference_path
from mjlab.scripts.list_envs import list_environments
from mjlab.tasks.registry import list_tasks


def test_all_tasks_are_listed_in_order(run):
    outcome = run("list_envs")
    assert outcome.status == 0
    assert [line.split()[1] for line in outcome.out.splitlines()] == list_tasks()
    assert [line.split()[0] for line in outcome.out.splitlines()][:2] == ["1", "2"]
    assert list_tasks() == sorted(list_tasks())


def test_tasks_with_reference_runs_show_their_minutes(run):
    lines = {line.split()[1]: line for line in run("list_envs").out.splitlines()}
    for task, line in lines.items():
        path = reference_path(DATA, task, "cpu")
        assert ("min" in line.split()) == path.is_file()
        if path.is_file():
            minutes = Reference.load(path).usual_minutes
            said = " solved in " if minutes is None else f"usually {minutes:.1f} min"
            assert said in line
    assert Reference.load(reference_path(DATA, "Mjlab-Cartpole-Swingup", "cpu")).usual_minutes


@pytest.mark.parametrize("keyword", ["swing", "SWING", "Swingup"])
def test_a_keyword_selects_whatever_its_case(run, keyword):
    outcome = run("list_envs", "--keyword", keyword)
    assert outcome.status == 0
    names = [line.split()[1] for line in outcome.out.splitlines()]
    assert names == list_environments(keyword)
    assert "Mjlab-Cartpole-Swingup" in names
    assert "Mjlab-Cartpole-Balance" not in names


def test_no_match_is_a_failure_with_a_message(run):
    outcome = run("list_envs", "--keyword", "no such thing")
    assert (outcome.status, outcome.out) == (1, "")
    assert "'no such thing'" in outcome.err


def test_an_unknown_flag_ends_with_status_2(run):
    assert run("list_envs", "--nonsense").status == 2
