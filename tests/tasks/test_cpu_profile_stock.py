"""Evaluations, `evaluate` and `play` do not see what `cpu` profiles ease."""

from __future__ import annotations

import pytest

from mjlab.tasks.registry import list_profiles, list_tasks, load_env_cfg
from mjlab.utils.os import to_plain

TASKS = [task for task in list_tasks() if "cpu" in list_profiles(task)]
CLOCKED = [t for t in TASKS if t.startswith("Mjlab-Velocity") and "Unitree-G1" in t]


def test_there_are_tasks_with_such_a_profile():
    assert len(TASKS) >= 10


@pytest.mark.parametrize("purpose", ["play", "evaluate"])
@pytest.mark.parametrize("task", TASKS)
def test_only_training_is_eased(task, purpose):
    plain = load_env_cfg(task, **{purpose: True})
    profiled = load_env_cfg(task, profile="cpu", **{purpose: True})
    # Action and observation spaces of the policy.
    if profiled.observations.pop("teacher", None) is not None:
        profiled.actions = plain.actions
    if task in CLOCKED:
        del profiled.commands["gait"]
        terms = plain.observations["actor"].terms
        for name in {
            "base_lin_vel",
            "base_ang_vel",
            "projected_gravity",
            "joint_pos",
        } & terms.keys():
            profiled.observations["actor"].terms[name].history_length = terms[name].history_length
        for group in profiled.observations.values():
            del group.terms["gait"]
    assert to_plain(profiled) == to_plain(plain)
