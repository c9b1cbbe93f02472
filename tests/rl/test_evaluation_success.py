"""Description of the success criterion."""

from __future__ import annotations

import functools
from typing import Any

import pytest
import torch

from mjlab.rl import EvaluationCfg
from mjlab.rl.evaluation import required_return, success_definition
from mjlab.tasks.manipulation.config.yam.rl_cfg import placed_at_goal


def upright(env: Any) -> torch.Tensor:
    """Return whether the pole stands within 10 degrees, (num_envs,) bool.

    More is said here.
    """
    return torch.ones(env.num_envs, dtype=torch.bool)


def unexplained(env: Any) -> torch.Tensor:
    return upright(env)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({}, None),
        ({"solved_return": 900.0}, "return of at least 900"),
        ({"solved_return": 900.0, "success_return": 700.0}, "return of at least 700"),
        (
            {"success_func": upright, "solved_return": 900.0},
            "the pole stands within 10 degrees (upright), one step before the end",
        ),
        ({"success_func": unexplained}, "unexplained, one step before the end"),
        (
            {"success_func": functools.partial(upright)},
            "the pole stands within 10 degrees (upright), one step before the end",
        ),
        (
            {"success_func": placed_at_goal},
            "the object is at its goal, or was at the last one if time ran out on a new one "
            "(placed_at_goal), one step before the end",
        ),
        (
            {"success_is_survival": True},
            "no termination before the time limit",
        ),
    ],
)
def test_the_definition_is_put_in_words(fields: dict[str, Any], words: str | None) -> None:
    assert success_definition(EvaluationCfg(**fields)) == words


def test_a_return_decides_only_where_nothing_else_does() -> None:
    assert required_return(EvaluationCfg(solved_return=3.0)) == 3.0
    assert required_return(EvaluationCfg(solved_return=3.0, success_func=upright)) is None
    assert required_return(EvaluationCfg(solved_return=3.0, success_is_survival=True)) is None
