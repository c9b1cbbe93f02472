"""`profile-env`: the time of a step, by phase and by term."""

from __future__ import annotations

import json

import pytest
from commands import TASK

from mjlab.scripts.profile_env import StepProfile, _format_times, profile_rows
from mjlab.tasks.registry import list_tasks

SMALL = ("--num-envs", "4", "--steps", "3", "--warm-up", "1", "--device", "cpu")


def test_the_table_names_phases_and_terms(run):
    outcome = run("profile_env", TASK, *SMALL)
    assert outcome.status == 0, outcome.err
    lines = [line.split() for line in outcome.out.splitlines()]
    assert ["phase", "ms", "%"] in lines
    assert ["manager", "term", "ms", "%"] in lines
    names = [line[:-2] for line in lines if line]
    for name in (["physics"], ["other"], ["rewards", "smooth_reward"], ["actions", "effort"]):
        assert name in names
    assert "4 environments" in outcome.out
    assert "over 3 steps" in outcome.out


def test_json_has_the_same_figures_and_they_add_up(run):
    outcome = run("profile_env", TASK, *SMALL, "--json", "--agent", "zero")
    assert outcome.status == 0, outcome.err
    figures = json.loads(outcome.out)
    assert (figures["task"], figures["num_envs"], figures["steps"]) == (TASK, 4, 3)
    assert figures["step_ms"] > 0
    phases = {row["name"]: row for row in figures["phases"]}
    assert sum(row["ms"] for row in phases.values()) == pytest.approx(figures["profiled_step_ms"])
    assert sum(row["percent"] for row in phases.values()) == pytest.approx(100.0)
    for manager in {row["manager"] for row in figures["terms"]}:
        terms = sum(row["ms"] for row in figures["terms"] if row["manager"] == manager)
        assert terms <= phases[manager]["ms"]


def profile() -> StepProfile:
    phases = {"physics": 0.8, "rewards": 0.2, "observations": 0.5}
    terms = {"rewards": {"a": 0.01, "b": 0.1}, "observations": {"actor/x": 0.4}}
    return StepProfile(num_steps=10, step_time=1.6, phases=phases, terms=terms)


def test_rows_are_sorted_by_time():
    figures = profile_rows(profile())
    assert [row["name"] for row in figures["phases"]] == [
        "physics", "observations", "rewards", "other",
    ]  # fmt: skip
    assert [(row["manager"], row["name"]) for row in figures["terms"]] == [
        ("observations", "actor/x"), ("rewards", "b"), ("rewards", "a"),
    ]  # fmt: skip
    first = figures["terms"][0]
    assert (first["ms"], first["percent"]) == (pytest.approx(40.0), pytest.approx(25.0))


@pytest.mark.parametrize("much", [True, False])
def test_terms_that_take_much_are_named(much):
    one = profile()
    if not much:
        one.step_time = 100.0
    head = {"task": "T", "num_envs": 8, "physics": "p", "steps": 10, "step_ms": 2.0}
    last = _format_times({**head, **profile_rows(one)}).splitlines()[-1]
    if much:
        assert last == (
            "More than 5 % of the step: observations/actor/x (25.0 %), rewards/b (6.2 %)."
        )
    else:
        assert last == "No term takes more than 5 % of the step."


@pytest.mark.parametrize(
    ("flag", "least"),
    [
        ("--num-envs", 1),
    ],
)
def test_numbers_that_are_too_small_are_refused(run, flag, least):
    outcome = run("profile_env", TASK, flag, str(least - 1))
    assert outcome.status == 1
    assert f"{flag}: expected an integer >= {least}, got {least - 1}" in outcome.message


@pytest.mark.slow
@pytest.mark.parametrize("task", list_tasks())
def test_every_task_can_be_profiled(run, task):
    outcome = run("profile_env", task, *SMALL, "--json")
    assert outcome.status == 0, outcome.err
    assert json.loads(outcome.out)["terms"]
