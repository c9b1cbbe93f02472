"""Curriculum terms: called at resets, their results logged."""

from __future__ import annotations

import torch

from mjlab.managers import CurriculumManager, CurriculumTermCfg


def test_results_are_logged_by_term_or_key(env):
    cfg = {
        "nothing": CurriculumTermCfg(func=lambda env, env_ids: None),
        "number": CurriculumTermCfg(func=lambda env, env_ids: 2),
        "tensor": CurriculumTermCfg(func=lambda env, env_ids: torch.tensor(1.5)),
        "several": CurriculumTermCfg(
            func=lambda env, env_ids: {"low": 1, "high": torch.tensor([3.0])}
        ),
    }
    manager = CurriculumManager(cfg, env)
    assert manager.reset(None) == {}, "nothing was computed yet"
    manager.compute(torch.tensor([0]))
    assert manager.reset(torch.tensor([0])) == {
        "Curriculum/number": 2,
        "Curriculum/tensor": 1.5,
        "Curriculum/several/low": 1,
        "Curriculum/several/high": 3.0,
    }
    assert manager.get_active_iterable_terms(0) == [
        ("nothing", []),
        ("number", [2.0]),
        ("tensor", [1.5]),
        ("several", [1.0, 3.0]),
    ]


def test_terms_get_the_environments_and_their_params(env):
    calls = []

    def func(env, env_ids, factor):
        calls.append((env_ids, factor))

    manager = CurriculumManager({"a": CurriculumTermCfg(func=func, params={"factor": 2})}, env)
    ids = torch.tensor([1, 2])
    manager.compute(ids)
    manager.compute()
    assert calls == [(ids, 2), (slice(None), 2)]
    assert manager.active_terms == ["a"]


def test_results_hold_until_the_next_compute(env):
    results = iter([1, 2])
    cfg = {"a": CurriculumTermCfg(func=lambda env, env_ids: next(results))}
    manager = CurriculumManager(cfg, env)
    manager.compute(None)
    assert manager.reset(None) == manager.reset(None) == {"Curriculum/a": 1}
    manager.compute(None)
    assert manager.reset(None) == {"Curriculum/a": 2}
