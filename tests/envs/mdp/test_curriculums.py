"""Curricula that edit term configs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjlab.compat.older import reward_weight
from mjlab.envs.mdp import curriculums
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.termination_manager import TerminationTermCfg


def make_env(cfg: Any) -> Any:
    manager = SimpleNamespace(get_term_cfg=lambda name: {"term": cfg}[name])
    return SimpleNamespace(
        reward_manager=manager, termination_manager=manager, common_step_counter=0
    )


def staged(kind: str, env: Any, stages: list[Any]) -> Any:
    params = {f"{kind}_name": "term", "stages": stages}
    cls = getattr(curriculums, f"{kind}_curriculum")
    term = cls(CurriculumTermCfg(func=cls, params=params), env)

    def at(step: int) -> dict[str, Any]:
        env.common_step_counter = step
        logged = term(env, torch.tensor([0]), **params)
        return {key: value.item() for key, value in logged.items()}

    return at


def test_stages_apply_in_order_and_are_logged() -> None:
    cfg = RewardTermCfg(func=None, weight=1.0, params={"std": 0.5, "name": "x"})
    at = staged(
        "reward",
        make_env(cfg),
        [
            {"step": 10, "weight": 2.0},
            {"step": 20, "weight": 3.0, "params": {"std": 0.25, "name": "y"}},
        ],
    )
    # Everything that any stage names is logged from the start, if it is a number.
    assert at(9) == {"weight": 1.0, "std": 0.5}
    assert at(10) == {"weight": 2.0, "std": 0.5}
    assert at(25) == {"weight": 3.0, "std": 0.25}
    assert cfg.params == {"std": 0.25, "name": "y"}


def test_terminations_have_stages_too() -> None:
    cfg = TerminationTermCfg(func=None, params={"limit": 1.0})
    at = staged("termination", make_env(cfg), [{"step": 5, "time_out": True}])
    assert at(0) == {"time_out": False}
    assert at(5) == {"time_out": True}
    assert cfg.time_out is True


def test_a_reward_weight_changes_once() -> None:
    cfg = RewardTermCfg(func=None, weight=1.0)
    env = make_env(cfg)
    weights = []
    for env.common_step_counter in (0, 10, 11, 20):
        weights.append(
            curriculums.modify_reward_weight(env, torch.tensor([0]), "term", -2.0, num_steps=10)
        )
    assert weights == [1.0, 1.0, -2.0, -2.0]
    assert cfg.weight == -2.0


@pytest.mark.parametrize(
    ("stages", "error", "message"),
    [
        ([{"step": 5}, {"step": 4}], ValueError, "'term'.*4 after 5"),
        ([{"weight": 1.0}], ValueError, "'term'.*'step'"),
        ([{"step": 0, "wieght": 1.0}], AttributeError, r"'wieght'.*'weight'"),
        ([{"step": 0, "params": {"sdt": 1.0}}], KeyError, r"'sdt'.*'std'"),
    ],
)
def test_mistakes_are_found_at_construction(
    stages: list[Any], error: type[Exception], message: str
) -> None:
    cfg = RewardTermCfg(func=None, weight=1.0, params={"std": 0.5})
    with pytest.raises(error, match=message):
        staged("reward", make_env(cfg), stages)


def test_the_older_curriculum_starts_one_step_later() -> None:
    cfg = RewardTermCfg(func=None, weight=1.0)
    env = make_env(cfg)
    stages: Any = [{"step": 0, "weight": 2.0}, {"step": 10, "weight": 3.0}]
    weights = []
    for step in (0, 1, 10, 11):
        env.common_step_counter = step
        weights.append(reward_weight(env, torch.tensor([0]), "term", stages).item())
    assert weights == [1.0, 2.0, 2.0, 3.0]
