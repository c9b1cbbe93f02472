"""Metrics of episodes: mean, sum, last and max of steps."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.managers import MetricsManager, MetricsTermCfg
from mjlab.managers.metrics_manager import REDUCE_OPTIONS


def value(env):
    return env.value


@given(
    steps=st.lists(
        st.lists(st.floats(-10.0, 10.0, width=32), min_size=3, max_size=3), min_size=1, max_size=6
    )
)
@settings(deadline=None, max_examples=40)
def test_reductions_agree_with_plain_python(make_env, steps):
    env = make_env(num_envs=3)
    cfg = {reduce: MetricsTermCfg(func=value, reduce=reduce) for reduce in REDUCE_OPTIONS}
    manager = MetricsManager(cfg, env)
    for step in steps:
        env.value = torch.tensor(step)
        manager.compute()
    log = manager.reset(None)
    by_env = list(zip(*steps, strict=True))
    plain = {
        "mean": lambda x: sum(x) / len(x),
        "sum": sum,
        "last": lambda x: x[-1],
        "max": max,
    }
    for reduce, function in plain.items():
        expected = sum(function(x) for x in by_env) / 3
        assert log[f"Episode_Metrics/{reduce}"].item() == pytest.approx(expected, abs=1e-4)


def test_an_unknown_reduction_is_refused(env):
    with pytest.raises(ValueError, match=r"'a'.*last.*max.*mean.*sum.*'median'"):
        MetricsManager({"a": MetricsTermCfg(func=value, reduce="median")}, env)


def test_resets_touch_only_their_environments(env):
    cfg = {reduce: MetricsTermCfg(func=value, reduce=reduce) for reduce in REDUCE_OPTIONS}
    manager = MetricsManager(cfg, env)
    env.value = torch.arange(4.0)
    manager.compute()
    manager.reset(torch.tensor([0, 1]))
    manager.compute()
    log = manager.reset(None)
    assert log["Episode_Metrics/sum"] == pytest.approx((0 + 1 + 4 + 6) / 4)
    assert log["Episode_Metrics/mean"] == pytest.approx(1.5)


def test_a_maximum_leaves_out_environments_that_have_not_stepped(env):
    manager = MetricsManager({"a": MetricsTermCfg(func=value, reduce="max")}, env)
    assert manager.reset(None)["Episode_Metrics/a"] == 0.0, "no steps at all"
    env.value = torch.tensor([-4.0, -2.0, -1.0, -3.0])
    manager.compute()
    manager.reset(torch.tensor([0, 1]))
    assert manager.reset(torch.tensor([0, 1]))["Episode_Metrics/a"] == 0.0
    assert manager.reset(None)["Episode_Metrics/a"] == -2.0


def test_without_steps_sums_and_means_are_zero_and_the_last_value_stays(env):
    cfg = {reduce: MetricsTermCfg(func=value, reduce=reduce) for reduce in REDUCE_OPTIONS}
    manager = MetricsManager(cfg, env)
    env.value = torch.full((4,), 5.0)
    manager.compute()
    manager.reset(None)
    log = manager.reset(None)
    assert log["Episode_Metrics/mean"] == 0.0
    assert log["Episode_Metrics/sum"] == 0.0
    assert log["Episode_Metrics/last"] == 5.0


def test_substep_terms_take_the_mean_of_substeps(env):
    cfg = {
        "mean": MetricsTermCfg(func=value, per_substep=True),
        "max": MetricsTermCfg(func=value, per_substep=True, reduce="max"),
        "step": MetricsTermCfg(func=value),
    }
    manager = MetricsManager(cfg, env)
    assert manager.needs_substep
    for step in ((1.0, 3.0), (5.0, 7.0)):
        for x in step:
            env.value = torch.full((4,), x)
            manager.compute_substep()
        manager.compute()
    assert manager.get_active_iterable_terms(2) == [
        ("mean", [6.0]),
        ("max", [6.0]),
        ("step", [7.0]),
    ]
    log = manager.reset(None)
    assert log["Episode_Metrics/mean"] == 4.0
    assert log["Episode_Metrics/max"] == 6.0, "of the means of steps, not of substeps"
    assert log["Episode_Metrics/step"] == 5.0


def test_step_terms_need_no_substeps_and_are_not_called_in_them(env):
    calls = []
    cfg = {"a": MetricsTermCfg(func=lambda env: calls.append(1) or env.value)}
    manager = MetricsManager(cfg, env)
    assert not manager.needs_substep
    manager.compute_substep()
    assert calls == []


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("reduce", REDUCE_OPTIONS)
def test_an_environment_that_is_not_finite_is_left_out_of_the_mean(env, reduce, bad):
    cfg = {
        "bad": MetricsTermCfg(func=value, reduce=reduce),
        "good": MetricsTermCfg(func=lambda env: torch.arange(4.0), reduce=reduce),
    }
    manager = MetricsManager(cfg, env)
    env.value = torch.tensor([2.0, bad, 6.0, 4.0])
    manager.compute()
    log = manager.reset(torch.tensor([0, 1, 2]))
    assert log["Episode_Metrics/bad"] == 4.0
    assert log["Episode_Metrics/good"] == 1.0, "each term leaves out its own environments"
    env.value = torch.full((4,), bad)
    manager.compute()
    assert manager.reset(torch.tensor([0, 1]))["Episode_Metrics/bad"] == 0.0
