"""Checks that functions bring along are made when a manager is built."""

from __future__ import annotations

import pytest
import torch

from mjlab.managers import RewardManager, RewardTermCfg, SceneEntityCfg
from mjlab.managers.build_checks import checked_when_built


@pytest.fixture
def seen() -> list[dict]:
    return []


def term(seen: list[dict], error: Exception | None = None):
    def check(env, *, size, asset_cfg, **_):
        seen.append({"env": env, "size": size, "joints": asset_cfg.joint_names})
        if error is not None:
            raise error

    @checked_when_built(check)
    def cost(env, size, asset_cfg, other=0):
        return torch.full((env.num_envs,), float(size))

    return cost


def cfg(func, **changes):
    params = {"size": 3, "asset_cfg": SceneEntityCfg("robot", joint_names=("joint_b",)), "other": 1}
    return RewardTermCfg(func=func, weight=1.0, params={**params, **changes})


def test_a_check_gets_the_parameters_with_selections_resolved(make_env, seen):
    env = make_env()
    manager = RewardManager({"a": cfg(term(seen))}, env)
    assert seen == [{"env": env, "size": 3, "joints": ["joint_b"]}]
    # At run time nothing is checked again.
    assert (manager.compute(dt=1.0) == 3.0).all()
    assert len(seen) == 1


def test_what_a_check_raises_is_labelled_with_the_term(make_env, seen):
    func = term(seen, ValueError("no such sensor"))
    with pytest.raises(ValueError, match="RewardManager term 'a': no such sensor"):
        RewardManager({"a": cfg(func)}, make_env())


def test_a_term_that_is_off_by_its_weight_is_checked_too(make_env, seen):
    off = cfg(term(seen))
    off.weight = 0.0
    RewardManager({"a": off}, make_env())
    assert len(seen) == 1
