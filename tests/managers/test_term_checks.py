"""Checks that functions bring along are made when a manager is built."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjlab.managers import RewardManager, RewardTermCfg, SceneEntityCfg
from mjlab.managers.term_checks import checked_when_built, require_entity
from mjlab.sensor import ContactSensor


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


def test_checks_skip_decorated_terms_with_other_parameters(make_env, seen):
    cost = term(seen)

    @functools.wraps(cost)
    def of_size_five(env):
        return cost(env, 5, None)

    manager = RewardManager({"a": RewardTermCfg(func=of_size_five, weight=1.0)}, make_env())
    assert (manager.compute(1.0) == 5.0).all()
    assert not seen


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


class Checked:
    """A term that checks a parameter when it is built, and draws."""

    def __init__(self, cfg, env):
        self.size = cfg.params["size"]
        if self.size < 0:
            raise TypeError("size is negative")

    def __call__(self, env, size, asset_cfg, other):
        return torch.full((env.num_envs,), float(self.size))

    def debug_vis(self, visualizer):
        raise NotImplementedError


def unfilled(kind, seen):
    if kind == "function":
        return cfg(term(seen, ValueError("size is negative")), size=-1), ValueError
    return cfg(Checked, size=-1), TypeError


@pytest.mark.parametrize("kind", ["function", "class"])
def test_an_unfilled_reward_with_a_weight_is_refused(make_env, seen, kind):
    on, error = unfilled(kind, seen)
    with pytest.raises(error, match="RewardManager term 'a': size is negative"):
        RewardManager({"a": on}, make_env())


def test_a_sensor_is_not_an_entity():
    class FakeScene(dict):
        entities = {"robot": "a robot"}

    sensor = object.__new__(ContactSensor)
    env: Any = SimpleNamespace(scene=FakeScene(robot="a robot", contact=sensor))
    assert require_entity(env, "robot") == "a robot"
    with pytest.raises(KeyError, match=r"entity 'contact'.*\['robot'\]"):
        require_entity(env, "contact")
