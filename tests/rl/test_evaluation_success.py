"""Success of an episode, and its description."""

from __future__ import annotations

from typing import Any

import pytest

from mjlab.rl import EvaluationCfg
from mjlab.rl.evaluation import success_definition


def upright(env: Any) -> Any:
    return None


@pytest.mark.parametrize(
    ("fields", "criterion", "words"),
    [
        ({}, None, None),
        ({"solved_return": 900.0}, 900.0, "return of at least 900"),
        ({"solved_return": 900.0, "success": 700.0}, 700.0, "return of at least 700"),
        ({"success": 0.0}, 0.0, "return of at least 0"),
        (
            {"success": f"{__name__}:upright", "solved_return": 9.0},
            upright,
            "upright, one step before the end",
        ),
        ({"success": "survival"}, "survival", "no termination before the time limit"),
    ],
)
def test_one_field_defines_success(fields: dict[str, Any], criterion: Any, words: str | None):
    cfg = EvaluationCfg(**fields)
    assert cfg.criterion == criterion
    assert success_definition(cfg) == words


def test_a_config_is_read_from_a_dict():
    cfg = EvaluationCfg(solved_return=3.0, num_episodes=7)
    assert EvaluationCfg.of({"solved_return": 3.0, "num_episodes": 7, "of_later": 1}) == cfg
    assert EvaluationCfg.of(cfg) is cfg
    assert EvaluationCfg.of(None) == EvaluationCfg()
